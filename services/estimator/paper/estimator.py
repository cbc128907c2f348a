"""Preset `paper` behind the Estimator interface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.errors import UserError
from common.geometry import se2
from services.estimator.paper.beam_fitting import fit as own_fit
from services.estimator.paper.perception import Descent, PaperEstimator
from services.estimator.paper.training import usable_ranges
from services.estimator.shared.asking import Conversation, alone
from services.estimator.shared.generative_models import Expected
from services.estimator.shared.interface import Hypothesis, Observation, Posterior, Predicted

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.scanner import Scanner
    from services.estimator.paper.beam_fitting import Fit
    from services.estimator.paper.decoder import PaperModel
    from services.estimator.paper.weights import ModelCard

HEADING_TOLERANCE = 1e-3  # rad, between a pose's and the model's


class PaperPerception:
    """The paper's estimator; the heading is the one of its training, there is no covariance."""

    name = "paper"

    def __init__(
        self, model: PaperModel, card: ModelCard, descent: Descent, pose: Array | None = None, fit: Fit | None = None
    ) -> None:
        """``pose`` (3,) to begin with; none: the map's centre. ``fit``: of another scanner's scans; none: its own."""
        self.card, self.model = card, model
        self.fit = fit or own_fit(card.scanner, card.scanner.angles(), np.array(card.scanner.mount), "")
        self._first = pose
        self.estimator = PaperEstimator(
            model, card.test_l1_mean, card.world.bounds, self._initial(pose), descent,
            model.norm.metric, known=pose is not None,
        )  # fmt: skip

    def _initial(self, pose: Array | None) -> Array:
        x, y = self.card.world.center() if pose is None else pose[:2]
        return np.array([x, y, self.card.heading])

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:  # noqa: ARG002
        """Begin anew at ``pose``, or where it began first; the heading and a covariance are not used."""
        self.estimator.restart(self._initial(self._first if pose is None else pose), known=pose is not None)

    def update(self, observation: Observation) -> Posterior:
        """Descend on one scan."""
        return alone(self.updating(observation))

    def updating(self, observation: Observation) -> Conversation[Posterior]:
        """The same as a conversation: see `asking`."""
        ranges = self.fit.ranges(usable_ranges(observation.ranges, observation.range_max))
        says = self.fit.of_all(observation.ranges > -np.inf)
        estimate = yield from self.estimator.updating(ranges, observation.goal, says)
        found = estimate.gradient
        return Posterior(
            estimate.state,
            (Hypothesis(estimate.pose, None, 1.0),),
            found.accuracy,
            found.attraction,
            found.xi,
            found.curvature,
            estimate.predicted if self.fit.same else self.fit.predicted(estimate.predicted, observation.angles)[0],
        )

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """See Estimator: the decoder knows one heading; +inf where it has no beams. Sigma is its mean error."""
        off = np.abs(se2.wrap(poses[:, 2] - self.card.heading))
        if (off > HEADING_TOLERANCE).any():
            raise UserError(
                f"preset paper predicts at its one heading, {np.rad2deg(self.card.heading):.1f} deg, "
                f"and was asked for {np.rad2deg(poses[off.argmax(), 2]):.1f} deg"
            )
        # Far outside the map single precision has no number.
        ranges = np.nan_to_num(self.fit.predicted(self.model.ranges(poses), angles), nan=np.inf, posinf=np.inf)
        return Predicted(ranges, np.full(ranges.shape, self.card.test_l1_mean))


class PaperScans:
    """The paper's decoder as a generative model: one heading, the beams of its training, no derivative by yaw."""

    ripple = 0.0  # not known

    def __init__(self, model: PaperModel, scanner: Scanner, heading: float, scale: float) -> None:
        """``scale`` m is the stated error of every beam: this decoder has one precision for all."""
        self.model, self.scanner, self.heading, self.scale = model, scanner, heading, scale

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """See GenerativeModel; raises UserError for other beams than those of the training."""
        scanner = self.scanner
        own = scanner.angles()
        index = np.abs(own[None, :] - se2.wrap(angles)[:, None]).argmin(axis=1)
        if np.abs(own[index] - angles).max() > abs(scanner.angle_increment):
            raise UserError("the paper's decoder predicts the beams of its training alone")
        poses = se2.compose(np.asarray(lasers, float).reshape(-1, 3), se2.inverse(np.array(scanner.mount)))
        poses[:, 2] = self.heading
        rows = [self.model.predict(pose) for pose in poses]
        ranges = np.array([row[0][index] for row in rows])
        jacobian = np.array([row[1][index] for row in rows])
        return Expected(ranges, np.full(ranges.shape, self.scale), jacobian)
