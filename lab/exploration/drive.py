"""One exploration in this process, in lockstep: simulator, mapper and controller without a bus."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from common.geometry.coverage import MIN_PASSAGE_M, mapped_share, points_in, reachable_area
from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import Belief, Goal, Map, Odom, Pose, Scan, Twist
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from lab.benchmarks.mapping import trajectory_errors
from lab.statistics import root_mean_square
from services.controller.growing_map import PlanningMap
from services.controller.navigator import Navigator
from services.controller.policies.exploration import ExplorationState, NoPath, Viewpoint
from services.controller.policies.planner import GeodesicPolicy
from services.mapper.service import belief_message, map_message
from services.mapper.slam.drive import Laser
from services.mapper.slam.mapper import Mapper
from services.simulator.simulation import Simulation, SimulationSetup

ChooseViewpoint = Callable[[ExplorationState], Viewpoint | NoPath | None]
CELL_M = 0.05  # of the map
MAP_PERIOD_NS = 1_000_000_000  # between two versions of the map, as in the mapper's service
LAST_SCANS = 15  # while the robot comes to a stand


@dataclass
class ExplorationRun:
    """What happened in one exploration."""

    truths: list[Array] = field(default_factory=list)  # (3,) true pose at each scan
    beliefs: list[Array] = field(default_factory=list)  # (3,) believed pose at each scan, in map
    contact_scans: int = 0  # scans at which the robot touched something
    held_back: int = 0  # scans at which the obstacle stop held the robot
    unmatched: int = 0  # scans that did not match the map
    phase: str = "exploring"
    reason: str = ""  # of the last status
    map: Map | None = None
    choice_ms: list[float] = field(default_factory=list)  # duration of each choice of a viewpoint


class RobotWithMapper:
    """Mapper and controller of an exploring robot, and the record of its run."""

    def __init__(self, robot: Robot, choose: ChooseViewpoint) -> None:
        self.run, self.finished = ExplorationRun(), False
        self._choose, self._policy = choose, GeodesicPolicy(robot, None)
        self._navigator = Navigator(robot, chosen_policy=self._policy)
        self._mapper: Mapper | None = None  # built for the first scan
        self._map: PlanningMap | None = None
        self._map_stamp_ns = -MAP_PERIOD_NS

    def step(self, odom: Odom, scan: Scan) -> Twist:
        """The velocity that answers a scan."""
        belief = self._update_mapper(odom, scan)
        self._navigator.on_scan(scan)
        command, status = self._navigator.step(belief)
        self.run.reason = status.reason
        if self._navigator.explorer is None:
            self._navigator.on_goal(Goal(stamp_ns=0, seq=1, pose=Pose(x=0.0, y=0.0), explore=True))
        self._choose_viewpoint()
        if self._navigator.explorer is not None:
            self.run.phase = self._navigator.explorer.phase
            self.finished = not self._navigator.explorer.active
        return command.twist

    def _update_mapper(self, odom: Odom, scan: Scan) -> Belief:
        """Localises the scan, and uses a new version of the map once in `MAP_PERIOD_NS`."""
        if self._mapper is None:
            laser = Laser(scan.angles(), scan.mount.array(), scan.range_max, scan.time_increment)
            self._mapper = Mapper(laser, CELL_M)
        mapper = self._mapper
        place = mapper.add(scan.stamp_ns * 1e-9, scan.ranges.astype(float), odom.pose.array())
        self.run.beliefs.append(place.pose)
        self.run.unmatched += not place.matched
        if mapper.outdated and scan.stamp_ns - self._map_stamp_ns >= MAP_PERIOD_NS:
            self._map_stamp_ns = scan.stamp_ns
            mapper.use(mapper.update(mapper.key_scans()))
            assert mapper.map is not None  # noqa: S101 - it was just made
            self._use_map(map_message(scan.stamp_ns, mapper.map))
        return belief_message(scan, place)

    def _use_map(self, message: Map) -> None:
        self.run.map = message
        planned = PlanningMap.of(message, self._policy.robot.radius)
        self._policy.use_map(planned.graph, jumped=self._map is not None and planned.jumped_from(self._map))
        self._map = planned
        self._navigator.on_map(planned)

    def _choose_viewpoint(self) -> None:
        exploration_state = self._navigator.take_exploration_state()
        if exploration_state is None:
            return
        began = time.perf_counter()
        viewpoint = self._choose(exploration_state)
        self.run.choice_ms.append(1e3 * (time.perf_counter() - began))
        self._navigator.use_viewpoint(viewpoint, exploration_state)


def explore(
    world: World, robot: Robot, choose: ChooseViewpoint, start: Array, seed: int, limit_s: float, *, beams: int = 622
) -> ExplorationRun:
    """Explores a world from ``start`` (3,) until the explorer has finished or failed, or for ``limit_s`` s."""
    explorer, scanner = RobotWithMapper(robot, choose), SCANNERS["tim571"].with_beams(beams)
    x, y, yaw = start.tolist()
    run, last_scans = explorer.run, 0
    with closing(Simulation(SimulationSetup(world, scanner, robot, (x, y, yaw), seed, sweep=True))) as simulation:
        while simulation.stamp_ns < limit_s * 1e9 and last_scans < LAST_SCANS:
            odom, truth, scan = simulation.observe()
            run.truths.append(truth.pose.array())
            run.contact_scans += truth.contact
            run.held_back += truth.stopped
            twist = explorer.step(odom, scan)
            last_scans += explorer.finished
            simulation.command(scan.stamp_ns, twist)
            simulation.advance()
    return run


def measure(run: ExplorationRun, world: World, robot: Robot) -> dict[str, Any]:
    """The numbers of one exploration."""
    truths, beliefs = np.array(run.truths), np.array(run.beliefs)
    # What can be reached through passages of at least MIN_PASSAGE_M, and through all that the robot just fits through.
    area, tight = (reachable_area(world, radius, truths[0]) for radius in (MIN_PASSAGE_M / 2, robot.radius))
    grid = None if run.map is None else run.map.grid
    # The map's origin is where the robot began.
    share, share_tight = (0.0 if grid is None else mapped_share(grid, points_in(a), truths[0]) for a in (area, tight))
    errors, _ = trajectory_errors(beliefs, truths)
    return {
        "phase": run.phase,
        "reason": run.reason,
        "mapped_share": share,
        "mapped_share_tight": share_tight,
        "reachable_m2": float(shapely.area(area)),
        "path_m": float(np.hypot(*np.diff(truths[:, :2], axis=0).T).sum()),
        "return_error_m": float(np.hypot(*(truths[-1] - truths[0])[:2])),
        "contact_scans": run.contact_scans,
        "held_back_scans": run.held_back,
        "lost_scans": run.unmatched,
        "seconds": len(truths) / SCANNERS["tim571"].rate,
        "belief_rms_m": root_mean_square(errors),
        "choices": len(run.choice_ms),
        "choice_ms_median": float(np.median(run.choice_ms)) if run.choice_ms else 0.0,
        "choice_ms_max": float(np.max(run.choice_ms)) if run.choice_ms else 0.0,
    }
