"""Beliefs, scans and drives, which the tests of the controller share."""

from __future__ import annotations

import functools
from contextlib import closing

import numpy as np

from common.geometry import se2
from common.geometry.world import World, load_world
from common.messages.definitions import Belief, Goal, Pose, Scan
from common.robot.scanner import SCANNERS
from services.controller.navigator import Navigator
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.planner import GeodesicPolicy
from services.simulator.simulation import Simulation, SimulationSetup

PERIOD_NS = 66_666_667
PERIOD_S = PERIOD_NS * 1e-9
KINDS = ("holonomic", "differential")
SCANNER = SCANNERS["tim571"].with_beams(135)
shipped = functools.cache(load_world)


@functools.cache
def free_space(name: str) -> FreeSpace:
    return FreeSpace.of(shipped(name))


def room(width: float, height: float, *obstacles: dict) -> World:
    boundary = [(0, 0), (width, 0), (width, height), (0, height)]
    return World(name="room", boundary=boundary, obstacles=list(obstacles))


def box(x, y, width, height, name="box") -> dict:
    return {"name": name, "box": {"center": (x, y), "size": (width, height)}}


def goal(x, y, **more) -> Goal:
    return Goal(stamp_ns=0, pose=Pose(x=x, y=y, yaw=more.pop("yaw", 0)), **more)


def belief(stamp_ns, pose, state="tracking") -> Belief:
    return Belief(stamp_ns=stamp_ns, state=state, pose=Pose.of(pose), xi=np.zeros(3), free_energy=0, accuracy=0)


def scan(stamp_ns, pose, world, scanner=SCANNER, rng=None) -> Scan:
    laser = se2.compose(np.asarray(pose, float), np.array(scanner.mount))
    ranges = world.ray_distances(laser[None], scanner.angles())[0]
    if rng is not None:
        ranges = scanner.add_noise(ranges, rng)
    return Scan.of_scanner(scanner, scanner.limit(ranges), stamp_ns)


def session(navigator, pose, drives, world, *, first=0, state="tracking"):
    """Drives a robot that moves exactly as commanded; returns (command, status, pose) for each scan.

    ``drives`` has a drive message or None for each scan.
    """
    pose, log = np.array(pose, float), []
    for stamp, drive_message in enumerate(drives, start=first):
        navigator.on_scan(scan(stamp * PERIOD_NS, pose, world))
        if drive_message is not None:
            navigator.on_drive(drive_message)
        command, status = navigator.step(belief(stamp * PERIOD_NS, pose, state))
        log.append((command, status, pose))
        pose = se2.compose(pose, command.twist.array() * PERIOD_S)
    return log


def drive(
    world,
    robot,
    start,
    to,
    limit=900,
    *,
    known=None,
    change=None,
    seed=0,
    stop=True,
    scanner=SCANNER,
    seen=None,
    state="tracking",
):
    """Drives in the simulator with the true pose as belief, until the robot stands at the goal ``to``.

    Returns true poses (T, 3), statuses and the number of scans with contact. ``known`` is the controller's map,
    ``stop`` the simulator's obstacle stop, ``change`` a function called before each scan, and ``seen`` a function that
    changes the scan for the controller.
    """  # fmt: skip
    navigator = Navigator(robot, chosen_policy=GeodesicPolicy(robot, known or world))
    navigator.on_goal(to)
    poses, statuses, contacts = [], [], 0
    with closing(Simulation(SimulationSetup(world, scanner, robot, start, seed, obstacle_stop=stop))) as simulation:
        while simulation.steps < limit:
            if change is not None:
                change(simulation)
            _, truth, observed = simulation.observe()
            poses.append(truth.pose.array())
            contacts += truth.contact
            navigator.on_scan(seen(observed) if seen else observed)
            command, status = navigator.step(belief(observed.stamp_ns, poses[-1], state))
            statuses.append(status)
            if status.state == "reached" and not np.any(simulation.physics.twist().round(3)):
                break
            simulation.command(observed.stamp_ns, command.twist)
            simulation.advance()
    return np.array(poses), statuses, contacts


def path_length(points) -> float:
    return float(np.hypot(*np.diff(np.asarray(points)[:, :2], axis=0).T).sum())
