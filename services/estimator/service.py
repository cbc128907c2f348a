"""The estimator service: publishes a belief and a prediction for each scan of a robot."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from common.errors import UserError
from common.geometry.pose_text import start_of_text
from common.messages.definitions import Belief, CmdVel, Goal, Hypothesis, Odom, Pose, Prediction, Scan, Stamped
from common.messages.requests import LocaliseRequest, ModelReply, ModelRequest, PredictRequest, Reply, Request
from common.messages.topics import (
    BELIEF,
    CMD_VEL,
    GOAL,
    LOCALISE,
    MODEL,
    ODOM,
    PREDICT,
    PREDICTION,
    SCAN,
    STATUS,
    Query,
    Topic,
)
from common.robot.ranges import ranges_for_localisation
from common.runtime.odometry_sync import OdometrySync, ScanWithOdometry
from common.runtime.service import Service
from services.estimator.factory import EstimatorOptions, Factory, Geometry, prepare
from services.estimator.model_card import ModelInUse, model_in_use
from services.estimator.paper.perception import Descent
from services.estimator.prediction_query import answer_prediction
from services.estimator.settings import EstimatorSettings
from services.estimator.shared.interface import Estimator, Observation, Posterior


def estimator_options(settings: EstimatorSettings) -> EstimatorOptions:
    """Converts the settings to options of the factory."""
    return EstimatorOptions(
        world=settings.world,
        estimator=settings.estimator,
        model=settings.model,
        models=settings.models,
        sigma=settings.sigma,
        seed=settings.seed,
        initial_pose=start_of_text(settings.initial_pose, "--initial-pose") if settings.initial_pose else None,
        descent=Descent(alpha=settings.alpha, iterations=settings.iterations),
    )


class Models:
    """World and weights, loaded once for all robots of a process."""

    def __init__(self, settings: EstimatorSettings) -> None:
        """Raises UserError if there are no weights for the world."""
        self.options = estimator_options(settings)
        self.factory: Factory = prepare(self.options)
        self._described: dict[int | None, ModelInUse | str] = {}

    def describe(self, beams: int | None) -> ModelInUse | str:
        """Describes the model for scans of ``beams`` beams, or returns the reason why it is unknown. Cached."""
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
    queries: ClassVar[tuple[Query, ...]] = (LOCALISE, MODEL, PREDICT)

    def __init__(self, settings: EstimatorSettings, models: Models | None = None) -> None:
        """``models`` are shared by several robots; by default they are loaded in `open`.

        The estimator is built at the first scan, for the geometry of that scan.
        """
        super().__init__(settings)
        motion_inputs = {"odometry": (ODOM,), "command": (CMD_VEL,)}.get(settings.prior, ())
        self.inputs = (SCAN, GOAL, *motion_inputs)  # type: ignore[misc]
        self.models = models
        self.geometry: Geometry | None = None
        self.estimator: Estimator | None = None
        self.model: ModelInUse | str = "no scan has come yet"  # or the reason why it is unknown
        self.goal: Goal | None = None
        self.odometry_sync = OdometrySync()  # used if the prior is odometry
        self.command: CmdVel | None = None
        self.last: tuple[int, Belief, Prediction] | None = None  # stamp in ns and results of the latest scan

    def open(self) -> None:
        """Loads the models, so that missing weights are an error now and not at the first scan."""
        settings = self.settings
        if self.models is None:
            self.log.info("loading the world", world=settings.world)
            self.models = Models(settings)
        self.model = self.models.describe(None)
        self.log.info("estimator", name=settings.estimator, world=settings.world, prior=settings.prior)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """Processes a scan; stores goal, odometry and command for the scans after it."""
        if isinstance(message, Goal):
            self.goal = None if message.cancel or message.explore else message
        elif isinstance(message, CmdVel):
            self.command = message
        elif isinstance(message, Odom):
            self._update_all(self.odometry_sync.add_odometry(message))
        elif isinstance(message, Scan):
            wait = self.settings.prior == "odometry"
            self._update_all(self.odometry_sync.add_scan(message) if wait else [(message, None)])

    def on_request(self, query: Query, request: Request) -> Reply:
        """Answers a request to localise again, to predict scans, or to describe the model."""
        if isinstance(request, ModelRequest):
            if isinstance(self.model, str):
                return ModelReply(ok=False, reason=self.model)
            return self.model.reply(weights=request.weights)
        if self.estimator is None or self.geometry is None:
            return query.reply(ok=False, reason="no scan has come yet")
        if isinstance(request, PredictRequest):
            return answer_prediction(self.estimator, request, self.geometry.angles, self.geometry.range_max)
        if not isinstance(request, LocaliseRequest):
            return super().on_request(query, request)
        start = None if request.pose is None else request.pose.array()
        self.estimator.restart(start if start is None or request.heading_known else start[:2])
        return Reply()

    def _update_all(self, scans: list[ScanWithOdometry]) -> None:
        for scan, odom in scans:
            if self.last is not None and self.last[0] == scan.stamp_ns:
                self._publish(*self.last[1:])  # a repeated scan gets the same belief again
            elif (estimator := self._estimator_for(scan)) is not None:
                self.update_estimator(scan, estimator, self._observation(scan, odom))

    def update_estimator(self, scan: Scan, estimator: Estimator, observation: Observation) -> None:
        """Updates the estimator and publishes the posterior."""
        self.publish_posterior(scan, estimator.update(observation), estimator.name)

    def publish_posterior(self, scan: Scan, posterior: Posterior, estimator: str) -> None:
        """Publishes the belief and the prediction after a scan."""
        belief, prediction = belief_message(scan, posterior, estimator), prediction_message(scan, posterior)
        self.last = (scan.stamp_ns, belief, prediction)
        self._publish(belief, prediction)

    def _publish(self, belief: Belief, prediction: Prediction) -> None:
        self.publish(PREDICTION, prediction)
        self.publish(BELIEF, belief)

    def _estimator_for(self, scan: Scan) -> Estimator | None:
        """Returns the estimator for a scan, and builds a new one if the scanner has changed.

        If there is no model for the scanner, logs the reason, puts it into the health note, and returns None.
        """
        assert self.models is not None  # noqa: S101 - set in open
        geometry = Geometry.of_scan(scan)
        try:
            paper = self.settings.estimator == "paper"
            if self.geometry is None or not self.geometry.same(geometry, bound_to_beams=paper):
                estimator = self.models.factory(geometry)
                if self.geometry is not None:
                    self.log.warning("the scanner or its mount has changed: localisation starts again")
                self.estimator, self.geometry = estimator, geometry
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

    def _observation(self, scan: Scan, odom: Odom | None) -> Observation:
        prior = self.settings.prior
        if prior == "odometry" and odom is None:
            self.counters["scans_without_odometry"] += 1
        command = self.command if prior == "command" else None
        return Observation(
            ranges_for_localisation(scan.ranges),
            scan.angles(),
            scan.range_max,
            scan.stamp_ns * 1e-9,
            odom.pose.array() if odom else None,
            command.twist.array() if command else None,
            self.goal.pose.array() if self.goal else None,
            time_increment=scan.time_increment,
        )


def belief_message(scan: Scan, posterior: Posterior, estimator: str) -> Belief:
    """The posterior after a scan as a message."""
    return Belief(
        stamp_ns=scan.stamp_ns,
        state=posterior.state,
        pose=Pose.of(posterior.pose),
        covariance=posterior.covariance,
        hypotheses=[
            Hypothesis(pose=Pose.of(each.pose), covariance=each.covariance, weight=each.weight)
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
