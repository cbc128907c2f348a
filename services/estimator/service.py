"""The estimator service: publishes a belief and a prediction for each scan of a robot."""

from __future__ import annotations

from concurrent.futures import Future
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from common.errors import UserError
from common.geometry.pose_text import parse_initial_pose
from common.geometry.world import World
from common.messages.definitions import (
    Belief,
    BeliefHypothesis,
    CmdVel,
    Goal,
    LearnedField,
    Odom,
    Pose,
    Prediction,
    Scan,
    Stamped,
)
from common.messages.requests import (
    LocaliseRequest,
    ModelReply,
    ModelRequest,
    PredictRequest,
    Reply,
    Request,
    SaveModelReply,
    SaveModelRequest,
)
from common.messages.topics import (
    BELIEF,
    CMD_VEL,
    FIELD,
    GOAL,
    LOCALISE,
    MODEL,
    ODOM,
    PREDICT,
    PREDICTION,
    SAVE_MODEL,
    SCAN,
    STATUS,
    Query,
    Topic,
)
from common.robot.ranges import ranges_for_localisation
from common.robot.robot import Robot
from common.runtime.odometry_sync import OdometrySync, ScanWithOdometry
from common.runtime.service import Service
from services.estimator.factory import (
    EstimatorFactory,
    EstimatorOptions,
    ScannerGeometry,
    check_start,
    prepare_factory,
)
from services.estimator.field_exchange import FieldAssembler, split_into_messages
from services.estimator.learner import EncodedVersion, Learner
from services.estimator.model_card import ModelInUse, model_in_use, save_learned
from services.estimator.paper.perception import Descent
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.key_scans import MIN_KEY_SCANS
from services.estimator.precise.learning.live_learning import mean_error
from services.estimator.precise.motion_model import MotionNoise
from services.estimator.prediction_query import answer_prediction
from services.estimator.settings import EstimatorSettings, ignored_settings
from services.estimator.shared.interface import Observation, PoseEstimator, Posterior

if TYPE_CHECKING:
    from common.geometry.se2 import Array

MAX_COMMAND_AGE_NS = int(Robot().command_age * 1e9)  # a robot does not follow older commands
# The learned field is published again after this time, for recordings that begin later.
FIELD_PERIOD_NS = 30_000_000_000


def estimator_options(settings: EstimatorSettings) -> EstimatorOptions:
    """Converts the settings to options of the factory."""
    return EstimatorOptions(
        world=settings.world,
        estimator=settings.estimator,
        model=settings.model,
        models=settings.models,
        sigma=settings.sigma,
        seed=settings.seed,
        initial_pose=parse_initial_pose(settings.initial_pose, "--initial-pose") if settings.initial_pose else None,
        descent=Descent(alpha=settings.alpha, iterations=settings.iterations),
        motion=MotionNoise.of_robot(
            settings.max_speed, settings.max_turn, settings.acceleration, settings.turn_acceleration
        ),
    )


class SharedModels:
    """World and weights, which are loaded once for all robots of a process."""

    def __init__(self, settings: EstimatorSettings) -> None:
        """Raises UserError if there are no weights for the world."""
        self.options = estimator_options(settings)
        self.world = self.options.loaded_world
        self.factory: EstimatorFactory = prepare_factory(self.options)
        self._described: dict[int | None, ModelInUse | str] = {}

    def describe(self, beams: int | None) -> ModelInUse | str:
        """Returns the description of the model for scans of ``beams`` beams, or the reason why it is unknown."""
        if beams not in self._described:
            try:
                self._described[beams] = model_in_use(self.options, beams)
            except UserError as error:
                self._described[beams] = str(error)
        return self._described[beams]


class EstimatorService(Service):
    """Publishes a belief and a prediction for each scan."""

    settings: EstimatorSettings
    name: ClassVar[str] = "estimator"
    single: ClassVar[bool] = True
    serves_latched: ClassVar[tuple[Topic, ...]] = (GOAL, STATUS)
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN, GOAL)
    queries: ClassVar[tuple[Query, ...]] = (LOCALISE, MODEL, PREDICT, SAVE_MODEL)

    def __init__(self, settings: EstimatorSettings, models: SharedModels | None = None) -> None:
        """``models`` are shared by several robots; by default they are loaded in `open`.

        The estimator is built at the first scan, for the geometry of that scan.
        """
        super().__init__(settings)
        motion_inputs = {"odometry": (ODOM,), "command": (CMD_VEL,)}.get(settings.prior, ())
        field_inputs = (FIELD,) if settings.learn == "follow" else ()
        self.inputs = (SCAN, GOAL, *motion_inputs, *field_inputs)  # type: ignore[misc]
        self.models = models
        self.geometry: ScannerGeometry | None = None
        self.estimator: PoseEstimator | None = None
        self.model: ModelInUse | str = "no scan has come yet"  # or the reason why it is unknown
        self.goal: Array | None = None  # (3,) in map
        self.odometry_sync = OdometrySync()  # used if the prior is odometry
        self.command: CmdVel | None = None
        self.last: tuple[int, Belief, Prediction] | None = None  # stamp in ns and results of the latest scan
        self.field_version = 0  # of the field learned while driving; 0 is the original model
        self._learner: Learner | None = None
        self._learned: EncodedVersion | None = None  # the learned version in use
        self._field_published_ns = 0  # stamp with which the learned version was published last
        self._assembler = FieldAssembler()
        self._followed: bytes | None = None  # the received field in use

    def open(self) -> None:
        """Loads the models, so that missing weights are an error now and not at the first scan."""
        settings = self.settings
        if settings.learn != "none" and settings.estimator != "precise":
            raise UserError(f"--learn {settings.learn}: only estimator precise learns, not {settings.estimator}")
        for warning in ignored_settings(settings.estimator, settings.changed):
            self.log.warning(warning)
        if self.models is None:
            self.log.info("loading the world", world=settings.world)
            self.models = SharedModels(settings)
        self.model = self.models.describe(None)
        if isinstance(self.model, ModelInUse) and self.model.world.name != self.models.world.name:
            self.log.warning(
                "the model was learned in another world, which is the map now",
                model=settings.model,
                learned_in=self.model.world.name,
                world=settings.world,
            )
        self.log.info("estimator", name=settings.estimator, world=settings.world, prior=settings.prior)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """Processes a scan; stores goal, odometry and command for the scans after it."""
        if isinstance(message, Goal):
            self.goal = self._pose_of_goal(message)
        elif isinstance(message, CmdVel):
            self.command = message
        elif isinstance(message, LearnedField):
            self._follow(message)
        elif isinstance(message, Odom):
            self._update_all(self.odometry_sync.add_odometry(message))
        elif isinstance(message, Scan):
            wait = self.settings.prior == "odometry"
            self._update_all(self.odometry_sync.add_scan(message) if wait else [(message, None)])

    def on_request(self, query: Query, request: Request) -> Reply | Future[Reply]:
        """Answers a request to localise again, to predict scans, or to describe or save the model."""
        if isinstance(request, ModelRequest):
            return self._describe_model(request)
        if isinstance(request, SaveModelRequest):
            return self._save_model(request.name)
        if self.estimator is None or self.geometry is None:
            return query.reply(ok=False, reason="no scan has come yet")
        if isinstance(request, PredictRequest):
            return answer_prediction(self.estimator, request, self.geometry.angles, self.geometry.range_max)
        if not isinstance(request, LocaliseRequest):
            return super().on_request(query, request)
        assert self.models is not None  # noqa: S101 - set in open
        start = None if request.pose is None else self.models.world.to_map(request.pose.array(), request.map_id)
        check_start(start, self.models.world)
        self.estimator.restart(start if start is None or request.heading_known else start[:2])
        if self._learner is not None:
            self._learner.keys.forget_unverified()
        return Reply()

    def _describe_model(self, request: ModelRequest) -> ModelReply:
        if isinstance(self.model, str):
            return ModelReply(ok=False, reason=self.model)
        return self.model.reply(weights=request.weights)

    def _pose_of_goal(self, goal: Goal) -> Array | None:
        """Pose (3,) of a goal in map; None if it has none, or is on an unknown floor."""
        assert self.models is not None  # noqa: S101 - set in open
        pose = None if goal.cancel or goal.explore else goal.pose_in_map(self.models.world)
        return None if pose is None else pose.array()

    def _update_all(self, scans: list[ScanWithOdometry]) -> None:
        for scan, odom in scans:
            if self.last is not None and self.last[0] == scan.stamp_ns:
                self._publish(*self.last[1:])  # a repeated scan gets the same belief again
            elif (estimator := self._estimator_for(scan)) is not None:
                self.update_estimator(scan, estimator, self._observation(scan, odom))

    def update_estimator(self, scan: Scan, estimator: PoseEstimator, observation: Observation) -> None:
        """Updates the estimator and publishes the posterior."""
        posterior = estimator.update(observation)
        self.publish_posterior(scan, posterior, estimator.name)
        if self._learner is not None and isinstance(estimator, PreciseEstimator):
            self._learner.add(posterior, observation, estimator.model)
            if posterior.state == "tracking":
                self._use_learned_version(self._learner, estimator, scan.stamp_ns)
            if self._learned is not None and not 0 <= scan.stamp_ns - self._field_published_ns < FIELD_PERIOD_NS:
                self._publish_field(self._learned, scan.stamp_ns)
            self.counters["field_version"] = self.field_version
            self.counters["key_scans"] = len(self._learner.keys)
            self.counters["key_scans_dropped"] = self._learner.keys.dropped_total

    def _use_learned_version(self, learner: Learner, estimator: PreciseEstimator, stamp_ns: int) -> None:
        """Switches to a newly learned version of the model, if there is one, and publishes it."""
        outcome = learner.take()
        if outcome is None:
            return
        if (learned := outcome.version) is None:
            self.counters["versions_rejected"] += 1
            self.log.info(
                "a new version predicts new scans no better, so the model stays",
                version=self.field_version,
                key_scans=len(learner.keys),
            )
            return
        estimator.use_model(learned.version.model, learned.version.seeds)
        self._learned, self.field_version = learned, self.field_version + 1
        self.log.info(
            "learned",
            version=self.field_version,
            key_scans=len(learned.version.key_poses),
            range_error_mm=round(mean_error(learned.version.errors) * 1e3, 2),
            before_mm=round(mean_error(learned.version.present_errors) * 1e3, 2),
        )
        self._publish_field(learned, stamp_ns)

    def _publish_field(self, learned: EncodedVersion, stamp_ns: int) -> None:
        self._field_published_ns = stamp_ns
        for message in split_into_messages(learned.data, self.field_version, self._base(), stamp_ns):
            self.publish(FIELD, message)

    def _base(self) -> str:
        """SHA-256 of the original model's weights; empty if it has none."""
        return "" if isinstance(self.model, str) else self.model.sha256

    def _follow(self, message: LearnedField) -> None:
        """Uses the field that another estimator has learned from the same model."""
        data = self._assembler.add(message)
        # Fields are sent again and again. Their version does not tell, as it begins again if the sender is restarted.
        if data is None or data == self._followed or not isinstance(self.estimator, PreciseEstimator):
            return
        if message.base != self._base():
            self.counters["other_fields"] += 1  # learned from another model
            return
        self.estimator.use_model(*weights.decode(data))
        self._followed, self.field_version = data, message.version

    def _save_model(self, name: str) -> SaveModelReply:
        if self._learned is None or self.geometry is None or isinstance(self.model, str):
            raise UserError(self._why_nothing_was_learned())
        path = save_learned(self.settings.saved_models, name, self.model, self._learned.version, self.geometry)
        self.log.info("model saved", file=str(path), version=self.field_version)
        return SaveModelReply(file=str(path), version=self.field_version)

    def _why_nothing_was_learned(self) -> str:
        if self._learner is None:
            return "nothing was learned: start with `presage up --learn`, and drive for a minute"
        if rejected := self._learner.rejected_total:
            return (
                f"nothing was learned yet: {rejected} new versions predicted new scans no better than the model in "
                "use, which is as good as the scans"
            )
        return (
            f"nothing was learned yet: {len(self._learner.keys)} key scans, and a version needs {MIN_KEY_SCANS} and "
            "half a minute of computing: drive on"
        )

    def close(self) -> None:
        """Ends the process that learns."""
        if self._learner is not None:
            self._learner.close()

    def publish_posterior(self, scan: Scan, posterior: Posterior, estimator: str) -> None:
        """Publishes the belief and the prediction after a scan."""
        world = None if self.models is None else self.models.world
        belief = belief_message(scan, posterior, estimator, world, self.field_version)
        prediction = prediction_message(scan, posterior)
        self.last = (scan.stamp_ns, belief, prediction)
        self._publish(belief, prediction)

    def _publish(self, belief: Belief, prediction: Prediction) -> None:
        self.publish(PREDICTION, prediction)
        self.publish(BELIEF, belief)

    def _estimator_for(self, scan: Scan) -> PoseEstimator | None:
        """Returns the estimator for a scan, and builds a new one if the scanner has changed.

        If there is no model for the scanner, logs the reason, puts it into the health note, and returns None.
        """
        assert self.models is not None  # noqa: S101 - set in open
        geometry = ScannerGeometry.of_scan(scan)
        try:
            paper = self.settings.estimator == "paper"
            if self.geometry is None or not self.geometry.same(geometry, bound_to_beams=paper):
                estimator = self.models.factory(geometry)
                if self.geometry is not None:
                    self.log.warning("the scanner or its mount has changed: localisation starts again")
                self.estimator, self.geometry = estimator, geometry
                self._start_learning(geometry)
                if paper:  # its weights depend on the number of beams
                    self.model = self.models.describe(len(geometry.angles))
        except UserError as error:
            self.counters["unfit_scans"] += 1
            if self.note != str(error):
                self.log.warning("scan refused", reason=str(error))
            self.note = str(error)
            return None
        self.note = ""
        return self.estimator

    def _start_learning(self, geometry: ScannerGeometry) -> None:
        """Starts to learn with the original model, if the settings say so."""
        self.close()
        self.field_version, self._learned, self._followed = 0, None, None
        if self.settings.learn == "refine" and isinstance(self.estimator, PreciseEstimator):
            self._learner = Learner(self.estimator, geometry)

    def _observation(self, scan: Scan, odom: Odom | None) -> Observation:
        prior = self.settings.prior
        if prior == "odometry" and odom is None:
            self.counters["scans_without_odometry"] += 1
        command = self.command if prior == "command" else None
        if command is not None and not 0 <= scan.stamp_ns - command.stamp_ns <= MAX_COMMAND_AGE_NS:
            command = None
        return Observation(
            ranges_for_localisation(scan.ranges),
            scan.angles(),
            scan.range_max,
            scan.stamp_ns * 1e-9,
            odom.pose.array() if odom else None,
            command.twist.array() if command else None,
            self.goal,
            time_increment=scan.time_increment,
        )


def belief_message(
    scan: Scan, posterior: Posterior, estimator: str, world: World | None = None, field_version: int = 0
) -> Belief:
    """The posterior after a scan as a message; ``world`` tells the floor."""
    floor = None if world is None else world.floor_at(posterior.pose)
    return Belief(
        stamp_ns=scan.stamp_ns,
        state=posterior.state,
        pose=Pose.of(posterior.pose),
        covariance=posterior.covariance,
        hypotheses=[
            BeliefHypothesis(pose=Pose.of(each.pose), covariance=each.covariance, weight=each.weight)
            for each in posterior.hypotheses
        ],
        xi=posterior.xi.astype(np.float32),
        curvature=posterior.curvature,
        free_energy=posterior.free_energy,
        accuracy=posterior.accuracy,
        complexity=posterior.complexity,
        probability=posterior.probability,
        protection=None if posterior.protection is None else posterior.protection.astype(np.float32),
        estimator=estimator,
        field_version=field_version,
        map_id="" if floor is None else floor.name,
    )


def prediction_message(scan: Scan, posterior: Posterior) -> Prediction:
    """The scan expected at the posterior's pose as a message."""
    return Prediction(
        stamp_ns=scan.stamp_ns,
        angle_min=scan.angle_min,
        angle_increment=scan.angle_increment,
        ranges=posterior.predicted.astype(np.float32),
        sigma=posterior.sigma.astype(np.float32),
    )
