"""The estimator's thin shell: scans in, beliefs and predictions out."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from common.errors import UserError
from common.messages import Belief, Goal, LocaliseRequest, Pose, Prediction, Reply, Request, Scan, Stamped
from common.service import Service
from common.topics import BELIEF, GOAL, LOCALISE, PREDICTION, SCAN, Query, Topic
from common.world import load_world
from services.estimator import weights
from services.estimator.decoder import use_one_core
from services.estimator.perception import Descent, PaperEstimator
from services.estimator.settings import EstimatorSettings
from services.estimator.training import usable_ranges

ANGLE_TOLERANCE = 1e-4  # rad, between a scan's beams and the model's


class EstimatorService(Service):
    """Perception as a process."""

    name: ClassVar[str] = "estimator"
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN, GOAL)
    queries: ClassVar[tuple[Query, ...]] = (LOCALISE,)

    def __init__(self, settings: EstimatorSettings) -> None:
        """Weights are loaded in `open`, for the beams at hand with the first scan."""
        super().__init__(settings)
        self.options = settings
        self.world_name = settings.world
        self.estimator: PaperEstimator | None = None
        self.card: weights.ModelCard | None = None
        self.goal: Goal | None = None
        self.last: tuple[int, Belief, Prediction] | None = None
        self.folder = settings.models or weights.FOLDER

    def open(self) -> None:
        """Fail now, not at the first scan, where a world has no weights at all."""
        use_one_core()
        self.world_name = load_world(self.options.world).name
        known = weights.available(self.folder, self.world_name, self.options.preset)
        if not known:
            raise UserError(
                f"no weights of preset {self.options.preset} for world {self.world_name!r} in {self.folder}; "
                f"make them with: {weights.train_command(self.options.world, self.options.preset)}"
            )
        for path in known.values():  # a broken file is found now, and torch is warm for the first scan
            model, card = weights.load(path)
            model.predict(np.array([*card.world.center(), card.heading]))

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """A scan makes a belief; a goal is remembered."""
        if isinstance(message, Goal):
            self.goal = None if message.cancel else message
        elif isinstance(message, Scan):
            self._perceive(message)

    def on_request(self, query: Query, request: Request) -> Reply:
        """Localise anew."""
        if query is not LOCALISE or not isinstance(request, LocaliseRequest):
            return super().on_request(query, request)
        if self.estimator is None or self.card is None:
            return Reply(ok=False, reason="no scan has come yet")
        pose = self._initial() if request.pose is None else request.pose.array()
        self.estimator.restart(np.array([pose[0], pose[1], self.card.heading]))
        return Reply()

    def _perceive(self, scan: Scan) -> None:
        if self.last is not None and self.last[0] == scan.stamp_ns:
            _, belief, prediction = self.last  # a scan sent again is answered again, not used again
        else:
            if not self._fits(scan):
                return
            belief, prediction = self._update(scan)
            self.last = (scan.stamp_ns, belief, prediction)
        self.publish(PREDICTION, prediction)
        self.publish(BELIEF, belief)

    def _fits(self, scan: Scan) -> bool:
        """Whether the model at hand, or one that lies ready, was trained for this scanner; says so where not."""
        try:
            if self.card is None or self.card.scanner.beams != len(scan.ranges):
                self._load(len(scan.ranges))
            self._check_geometry(scan)
        except UserError as error:
            self.counters["unfit_scans"] += 1
            if self.note != str(error):
                self.log.warning("scan refused", why=str(error))
            self.note = str(error)
            return False
        self.note = ""
        return True

    def _load(self, beams: int) -> None:
        path = weights.find(self.folder, self.world_name, self.options.preset, beams)
        model, self.card = weights.load(path)
        options = self.options
        self.estimator = PaperEstimator(
            model,
            self.card.test_l1_mean,
            self.card.world.bounds,
            self._initial(),
            Descent(alpha=options.alpha, beta=options.beta, iterations=options.iterations),
        )
        self.log.info("model", weights=path.name, test_l1_mean_m=round(self.card.test_l1_mean, 3))

    def _check_geometry(self, scan: Scan) -> None:
        assert self.card is not None  # noqa: S101 - set by _load
        scanner = self.card.scanner
        off = np.abs(
            [scan.angle_min - scanner.angle_min, (scan.angle_increment - scanner.angle_increment) * scanner.beams]
        )
        if off.max() > ANGLE_TOLERANCE or np.abs(scan.mount.array() - np.array(scanner.mount)).max() > ANGLE_TOLERANCE:
            raise UserError(
                f"the scan's beams or mounting are not those of {scanner.name} that the weights were trained for; "
                f"train for this scanner: {weights.train_command(self.options.world, self.options.preset)}"
            )

    def _initial(self) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        assert self.card is not None  # noqa: S101 - set by _load
        text = self.options.initial_pose
        x, y = (float(part) for part in text.split(",")[:2]) if text else self.card.world.center()
        return np.array([x, y, self.card.heading])

    def _update(self, scan: Scan) -> tuple[Belief, Prediction]:
        assert self.estimator is not None  # noqa: S101 - set by _load
        ranges = usable_ranges(scan.ranges.astype(np.float64), scan.range_max)
        goal = self.goal.pose.array() if self.goal is not None else None
        estimate = self.estimator.update(ranges, goal)
        found = estimate.gradient
        belief = Belief(
            stamp_ns=scan.stamp_ns,
            state=estimate.state,
            pose=Pose.of(estimate.pose),
            covariance=None,  # the paper's estimator has none: Sigma_o = 1 is no measurement noise
            xi=found.xi.astype(np.float32),
            curvature=found.curvature,
            free_energy=found.accuracy + found.attraction,
            accuracy=found.accuracy,
            complexity=found.attraction,
            estimator=self.options.preset,
        )
        prediction = Prediction(
            stamp_ns=scan.stamp_ns,
            angle_min=scan.angle_min,
            angle_increment=scan.angle_increment,
            ranges=estimate.predicted.astype(np.float32),
        )
        return belief, prediction
