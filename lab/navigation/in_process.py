"""One drive in this process, in lockstep: simulator, estimator and controller without a bus.

The same objects as in the services process the same messages in the same order, so the results are those of the real
processes in lockstep (`lab.experiments.lockstep`), which take three times as long.
"""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass, field

from common.messages.definitions import Belief, Goal, Health, Odom, Pose, Scan, Twist
from common.messages.requests import PredictRequest
from common.robot.ranges import ranges_for_localisation
from lab.experiments.lockstep import RunTrace
from services.controller.navigator import Navigator
from services.controller.policies.planner import GeodesicPolicy
from services.controller.service import PREDICTED_BEAMS
from services.estimator.factory import EstimatorFactory, EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.prediction_query import answer_prediction
from services.estimator.service import belief_message
from services.estimator.shared.interface import Observation, PoseEstimator
from services.simulator.simulation import Simulation, SimulationSetup

SCANS_TO_STAND = 15  # 1 s; when the goal is reached, the robot is about to stop


@dataclass(frozen=True)
class NavigationRun:
    """Parameters of a drive; its results depend on nothing else."""

    simulation: SimulationSetup
    estimator: EstimatorOptions
    goal: tuple[float, float]  # m in map
    odometry: bool  # whether the estimator is given odometry
    epistemic: bool  # whether motions are judged by the information that they gain
    limit: int  # maximum number of scans


@dataclass
class LocalisedRobot:
    """Estimator and controller of one robot, and the record of its drive."""

    factory: EstimatorFactory
    navigator: Navigator
    policy: GeodesicPolicy
    odometry: bool
    trace: RunTrace = field(default_factory=RunTrace)
    step_us: list[int] = field(default_factory=list)  # processor time of the controller's steps
    _estimator: PoseEstimator | None = None  # built for the first scan

    def step(self, odom: Odom, scan: Scan) -> Twist:
        """The velocity that answers a scan."""
        geometry = ScannerGeometry.of_scan(scan)
        if self._estimator is None:
            self._estimator = self.factory(geometry)
        posterior = self._estimator.update(self._observation(odom, scan))
        belief = belief_message(scan, posterior, self._estimator.name)
        self.navigator.on_scan(scan)
        took_us = self._predict(belief, self._estimator, geometry)
        began = time.thread_time_ns()
        command, status = self.navigator.step(belief)
        self.step_us.append((time.thread_time_ns() - began) // 1000 + took_us)
        if self.policy.field_changed:
            self.policy.field_changed = False
            self.trace.plans.append(scan.stamp_ns)
        self.trace.beliefs.append(belief)
        self.trace.statuses[scan.stamp_ns] = status
        if self.trace.ended_ns is None and (status.state == "reached" or status.refused):
            self.trace.ended_ns = scan.stamp_ns
        return command.twist

    def _observation(self, odom: Odom, scan: Scan) -> Observation:
        return Observation(
            ranges_for_localisation(scan.ranges),
            scan.angles(),
            scan.range_max,
            scan.stamp_ns * 1e-9,
            odom.pose.array() if self.odometry else None,
            time_increment=scan.time_increment,
        )

    def _predict(self, belief: Belief, estimator: PoseEstimator, geometry: ScannerGeometry) -> int:
        """Gives the policy the scans that it needs predicted. Returns the microseconds that the controller spent."""
        if not self.navigator.goal_state.active:
            return 0
        began = time.thread_time_ns()
        paths = self.policy.prediction_request(belief)
        took_us = (time.thread_time_ns() - began) // 1000
        if paths is not None:
            request = PredictRequest(poses=paths.poses().reshape(-1, 3), beams=PREDICTED_BEAMS)
            self.policy.use_predictions(answer_prediction(estimator, request, geometry.angles, geometry.range_max))
        return took_us


def run(params: NavigationRun) -> RunTrace:
    """Drives until the controller reports that the goal is reached or refused, and the robot stands."""
    setup = params.simulation
    policy = GeodesicPolicy(setup.robot, setup.world, epistemic=params.epistemic)
    navigator = Navigator(setup.robot, world=setup.world, chosen_policy=policy)
    robot = LocalisedRobot(prepare_factory(params.estimator), navigator, policy, params.odometry)
    navigator.on_goal(Goal(stamp_ns=0, seq=1, pose=Pose(x=params.goal[0], y=params.goal[1])))
    trace, scans_after_end = robot.trace, 0
    with closing(Simulation(setup)) as simulation:
        while len(trace.truths) <= params.limit and scans_after_end <= SCANS_TO_STAND:
            odom, truth, scan = simulation.observe()
            trace.truths.append(truth)
            twist = robot.step(odom, scan)
            scans_after_end += trace.ended_ns is not None
            simulation.command(scan.stamp_ns, twist)
            simulation.advance()
    steps = {"steps": len(robot.step_us), "step_us": sum(robot.step_us), "step_us_max": max(robot.step_us)}
    trace.health = Health(stamp_ns=trace.truths[-1].stamp_ns, service="controller", uptime=0.0, counters=steps)
    return trace
