"""Preset `paper` behind the PoseEstimator interface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.errors import UserError
from common.geometry import se2
from services.estimator.paper.beam_fitting import fit as own_fit
from services.estimator.paper.perception import Descent, PaperPerception
from services.estimator.paper.training import usable_ranges
from services.estimator.shared.generative_models import Expected
from services.estimator.shared.interface import Hypothesis, Observation, Posterior, Predicted

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.scanner import Scanner
    from services.estimator.paper.beam_fitting import BeamFit
    from services.estimator.paper.decoder import PaperModel
    from services.estimator.paper.weights import ModelCard

HEADING_TOLERANCE_RAD = 1e-3  # between a pose and the model


class PaperEstimator:
    """The paper's estimator of x and y, for the one heading of its training, without covariance."""

    name = "paper"

    def __init__(
        self,
        model: PaperModel,
        card: ModelCard,
        descent: Descent,
        pose: Array | None = None,
        fit: BeamFit | None = None,
    ) -> None:
        """``pose`` (3,) is the initial pose, by default the centre of the map.

        ``fit`` converts scans of another scanner; by default scans have the beams of the training.
        """
        self.card, self.model = card, model
        self.fixed_heading = card.heading  # rad, of every pose
        self.fit = fit or own_fit(card.scanner, card.scanner.angles(), np.array(card.scanner.mount), "")
        self._first = pose
        self.estimator = PaperPerception(
            model,
            card.test_l1_mean,
            card.world.bounds,
            self._initial(pose),
            descent,
            model.norm.metric,
            known=pose is not None,
        )

    def _initial(self, pose: Array | None) -> Array:
        x, y = self.card.world.center() if pose is None else pose[:2]
        return np.array([x, y, self.card.heading])

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:  # noqa: ARG002
        """Starts at ``pose`` or, by default, at the first initial pose; its heading and the covariance are not used."""
        self.estimator.restart(self._initial(self._first if pose is None else pose), known=pose is not None)

    def update(self, observation: Observation) -> Posterior:
        """Returns the posterior after descending on one scan."""
        ranges = self.fit.ranges(usable_ranges(observation.ranges, observation.range_max))
        measured = self.fit.valid_beams(observation.ranges > -np.inf)
        estimate = self.estimator.update(ranges, observation.goal, measured)
        free_energy = estimate.free_energy
        predicted = estimate.predicted
        if not self.fit.same:
            predicted = self.fit.predicted(predicted, observation.angles)[0]
        return Posterior(
            state=estimate.state,
            hypotheses=(Hypothesis(estimate.pose, None, 1.0),),
            accuracy=free_energy.accuracy,
            complexity=free_energy.attraction,  # to the goal; the paper has no complexity term
            xi=free_energy.xi,
            curvature=free_energy.curvature,
            predicted=predicted,
        )

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """Predicts scans (see PoseEstimator), at the decoder's heading only; +inf where it has no beams.

        Sigma is the decoder's mean error on test scans.
        """
        off = np.abs(se2.wrap(poses[:, 2] - self.card.heading))
        if (off > HEADING_TOLERANCE_RAD).any():
            raise UserError(
                f"preset paper predicts at its one heading, {np.rad2deg(self.card.heading):.1f} deg, "
                f"and was asked for {np.rad2deg(poses[off.argmax(), 2]):.1f} deg"
            )
        # Far outside the map the result is not finite in single precision.
        ranges = np.nan_to_num(self.fit.predicted(self.model.ranges(poses), angles), nan=np.inf, posinf=np.inf)
        return Predicted(ranges, np.full(ranges.shape, self.card.test_l1_mean))


class PaperGenerativeModel:
    """The paper's decoder as a GenerativeModel.

    It predicts at one heading, only the beams of its training, and without derivative by yaw.
    """

    def __init__(self, model: PaperModel, scanner: Scanner, heading: float, scale: float) -> None:
        """``scale`` m is the stated error of every beam, since the decoder has the same precision for all."""
        self.model, self.scanner, self.heading, self.scale = model, scanner, heading, scale

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """Predicts scans (see GenerativeModel). Raises UserError for other beams than those of the training."""
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

    def expect_behind(self, lasers: Array, angles: Array, ranges: Array) -> Array:  # noqa: ARG002
        """See GenerativeModel. The decoder knows nothing behind the first surface."""
        return np.full(ranges.shape, np.inf)
