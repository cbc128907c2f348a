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
from common.messages.definitions import Belief, Goal, Map, Pose
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from lab.benchmarks.mapping import trajectory_errors
from services.controller.growing_map import PlannedMap
from services.controller.navigator import Navigator
from services.controller.policies.exploration import Survey, View
from services.controller.policies.planner import GeodesicPolicy
from services.mapper.service import belief_message, map_message
from services.mapper.slam.drive import Laser
from services.mapper.slam.mapper import Mapper
from services.simulator.simulation import Setup, Simulation

Choice = Callable[[Survey], View | None]
MAP_PERIOD_NS = 1_000_000_000  # between two versions of the map, as in the mapper's service
LAST_SCANS = 15  # while the robot comes to a stand


@dataclass
class Exploration:
    """What happened, one entry for each scan."""

    truths: list[Array] = field(default_factory=list)  # (3,)
    beliefs: list[Array] = field(default_factory=list)  # (3,)
    contacts: list[Array] = field(default_factory=list)  # (3,) true poses with a contact
    held_back: int = 0  # scans at which the obstacle stop held the robot
    lost: int = 0  # scans that did not match the map
    phase: str = "exploring"
    reason: str = ""  # of the last status
    map: Map | None = None
    choice_ms: list[float] = field(default_factory=list)
    targets: list[Array] = field(default_factory=list)  # (3,) in map


def explore(
    world: World, robot: Robot, choice: Choice, start: Array, seed: int, limit_s: float, *, beams: int = 622
) -> Exploration:
    """Explore a world from ``start`` (3,) until the explorer has finished or failed, or for ``limit_s`` s."""
    policy, run = GeodesicPolicy(robot, None), Exploration()
    navigator = Navigator(robot, preset=policy)
    scanner = SCANNERS["tim571"].with_beams(beams)
    mapper: Mapper | None = None
    planned: PlannedMap | None = None
    updated_ns, last = -MAP_PERIOD_NS, 0
    with closing(Simulation(Setup(world, scanner, robot, _pose(start), seed, sweep=True))) as simulation:
        while simulation.stamp_ns < limit_s * 1e9 and last < LAST_SCANS:
            odom, truth, scan = simulation.observe()
            if mapper is None:
                mapper = Mapper(Laser(scan.angles(), scan.mount.array(), scan.range_max, scan.time_increment), 0.05)
            place = mapper.add(scan.stamp_ns * 1e-9, scan.ranges.astype(float), odom.pose.array())
            belief: Belief = belief_message(scan, place)
            run.truths.append(truth.pose.array())
            run.beliefs.append(place.pose)
            run.contacts += [truth.pose.array()] if truth.contact else []
            run.held_back += truth.stopped
            run.lost += not place.matched
            if mapper.outdated and scan.stamp_ns - updated_ns >= MAP_PERIOD_NS:
                updated_ns = scan.stamp_ns
                mapper.use(mapper.update(mapper.key_scans()))
                assert mapper.map is not None  # noqa: S101 - it was just made
                run.map = map_message(scan.stamp_ns, mapper.map)
                new = PlannedMap.of(run.map, robot.radius)
                policy.use_map(new.graph, jumped=planned is not None and new.jumped_from(planned))
                planned = new
                navigator.on_map(new)
            navigator.on_scan(scan)
            command, status = navigator.step(belief)
            run.reason = status.reason
            if navigator.explorer is None:
                navigator.on_goal(Goal(stamp_ns=0, seq=1, pose=Pose(x=0.0, y=0.0), explore=True))
            if (survey := navigator.take_survey()) is not None:
                began = time.perf_counter()
                view = choice(survey)
                run.choice_ms.append(1e3 * (time.perf_counter() - began))
                if view is not None:
                    run.targets.append(view.pose)
                navigator.use_view(view, survey)
            if navigator.explorer is not None:
                run.phase = navigator.explorer.phase
                last += not navigator.explorer.active
            simulation.command(scan.stamp_ns, command.twist)
            simulation.advance()
    return run


def _pose(pose: Array) -> tuple[float, float, float]:
    x, y, yaw = pose.tolist()
    return x, y, yaw


def measure(run: Exploration, world: World, robot: Robot) -> dict[str, Any]:
    """The numbers of one exploration."""
    truths, beliefs = np.array(run.truths), np.array(run.beliefs)
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
        "contact_scans": len(run.contacts),
        "held_back_scans": run.held_back,
        "lost_scans": run.lost,
        "seconds": len(truths) / 15,
        "belief_rms_m": float(np.sqrt((errors**2).mean())),
        "choices": len(run.choice_ms),
        "choice_ms_median": float(np.median(run.choice_ms)) if run.choice_ms else 0.0,
        "choice_ms_max": float(np.max(run.choice_ms)) if run.choice_ms else 0.0,
    }
