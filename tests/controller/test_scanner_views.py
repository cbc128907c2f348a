"""Scanners with a limited view, mounted backwards or upside down: driving direction and free space."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import World
from common.messages.definitions import Goal, Pose, Scan
from common.robot.base import Robot
from common.robot.scan_geometry import ALL_ROUND, Sector, Sweep
from common.robot.scanner import SCANNERS
from services.controller.navigator import Navigator
from services.controller.policies.action_selection import VIEW_MARGIN_RAD, Surroundings, select_action
from services.controller.policies.active_localisation import ActiveLocaliser
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.motion_model import turn_to_attractor
from services.controller.policies.obstacles import TemporaryObstacles
from services.controller.policies.planner import BLIND_AHEAD, GeodesicPolicy
from services.simulator.simulation import Setup, Simulation
from tests.controller.policies.test_planner import belief_at

HALL = World(name="hall", boundary=[(0, 0), (8, 0), (8, 6), (0, 6)])
BOX = {"name": "new", "box": {"center": (4.0, 1.5), "size": (0.5, 0.5)}}
LMS = SCANNERS["lms200"].model_copy(update={"rate": 15.0})  # its real rate takes five times as long
BACKWARDS = LMS.model_copy(update={"mount": (-0.2, 0.0, np.pi)})
A1 = SCANNERS["rplidar-a1"]
TURNED = {
    "0 to 359 deg": A1.model_copy(update={"first": 0.0}),
    "upside down": A1.model_copy(update={"upside_down": True}),
    "half, upside down": LMS.model_copy(update={"upside_down": True}),
}


def scan_of(scanner, world, pose, stamp_ns=0):
    ranges = world.ray_distances(se2.compose(pose, np.array(scanner.mount))[None], scanner.angles())[0]
    return Scan(
        stamp_ns=stamp_ns,
        angle_min=scanner.angle_min,
        angle_increment=scanner.angle_increment,
        range_min=scanner.range_min,
        range_max=scanner.range_max,
        ranges=scanner.limit(ranges).astype(np.float32),
        mount=Pose.of(scanner.mount),
    )


def around(view, **more):
    return Surroundings(
        lambda p: np.full(p.shape[:-1], np.inf), np.zeros((0, 2)), np.zeros(0, bool), 0.0, 0.33, view=view, **more
    )


@pytest.mark.parametrize(
    ("scanner", "sector"),
    [
        (SCANNERS["tim571"], Sector(0.0, np.deg2rad(135))),
        (LMS, Sector(0.0, np.pi / 2)),
        (BACKWARDS, Sector(-np.pi, np.pi / 2)),
        (A1, ALL_ROUND),
        *((scanner, ALL_ROUND) for name, scanner in TURNED.items() if "half" not in name),
        (LMS.model_copy(update={"first": 0.0}), Sector(np.pi / 2, np.pi / 2)),
        (LMS.model_copy(update={"first": 0.0, "upside_down": True}), Sector(-np.pi / 2, np.pi / 2)),
    ],
)
def test_sector_in_base_link(scanner, sector):
    scan = scan_of(scanner, HALL, np.array([4.0, 3.0, 1.0]))
    found = Sweep.of(scan).sector(scan.mount.yaw)
    assert found.half == pytest.approx(sector.half)
    assert np.cos(found.centre - sector.centre) == pytest.approx(1.0)


@pytest.mark.parametrize("half_deg", [30, 60, 90, 135])
@pytest.mark.parametrize("centre", [0.0, np.pi, 1.0])
def test_actions_stay_within_the_view(centre, half_deg):
    view = Sector(centre, np.deg2rad(half_deg))
    for goal in np.arange(0, 2 * np.pi, 0.5):
        attractor = 3 * np.array([np.cos(goal), np.sin(goal)])
        action = select_action(np.zeros(3), attractor, around(view), Robot()).action
        if np.hypot(*action[:2]) > 0.02:
            off = abs(float(se2.wrap(np.arctan2(action[1], action[0]) - centre)))
            assert off <= max(view.half - VIEW_MARGIN_RAD, view.half / 3) + 1e-6
        else:
            turned = turn_to_attractor(action, attractor, Robot(), may_turn=True, forward=around(view).forward)
            assert abs(turned[2]) > 0.1  # turns until the attractor is in view


@pytest.mark.parametrize("name", TURNED)
def test_removed_obstacle_is_forgotten_for_any_beam_order(name):
    scanner, pose = TURNED[name], np.array([2.0, 1.5, 0.4])
    changed = World(name="hall", boundary=HALL.boundary, obstacles=[BOX])
    layer = TemporaryObstacles(FreeSpace.of(HALL))
    layer.update(scan_of(scanner, changed, pose), pose)
    assert len(layer.points()) >= 4
    assert np.abs(layer.points() - [3.75, 1.5]).max() < 0.4
    layer.update(scan_of(scanner, HALL, pose, 10**9), pose)
    assert len(layer.points()) == 0


@pytest.mark.parametrize("name", TURNED)
def test_wanders_to_free_space_for_any_beam_order(name):
    policy, pose = GeodesicPolicy(Robot(), HALL), np.array([1.0, 3.0, 0.0])
    scan = scan_of(TURNED[name], HALL, pose, 2 * 10**9)
    policy.observe(scan, belief_at(pose, scan.stamp_ns, "lost"))
    localiser: ActiveLocaliser = policy.localiser
    for stamp in (0, 2 * 10**9):
        decision = localiser.decide(belief_at(pose, stamp, "lost"), scan, np.zeros((0, 2)), np.zeros(3), policy._view)
    assert decision.state == "exploring"
    assert decision.action[0] > 0.1  # there is most room ahead
    assert abs(decision.action[1]) < decision.action[0]


def test_unmeasured_beams_count_neither_as_free_nor_as_wall():
    """With every other beam unmeasured the action is the same; with all of them unmeasured there is no room."""
    pose, none = np.array([1.0, 3.0, 0.0]), np.zeros((0, 2))
    whole = scan_of(TURNED["0 to 359 deg"], HALL, pose)
    found = []
    for unmeasured in (slice(0, 0), slice(0, None, 2), slice(None)):
        ranges = np.array(whole.ranges)
        ranges[unmeasured] = 0.0
        scan, policy = whole.model_copy(update={"ranges": ranges, "stamp_ns": 2 * 10**9}), GeodesicPolicy(Robot(), HALL)
        policy.observe(scan, belief_at(pose, scan.stamp_ns, "lost"))
        for stamp in (0, 2 * 10**9):
            decision = policy.localiser.decide(belief_at(pose, stamp, "lost"), scan, none, np.zeros(3), policy._view)
        assert decision.state == "exploring"
        found.append(decision.action)
    np.testing.assert_allclose(found[1], found[0], atol=0.05)
    assert not found[2][:2].any()  # turns on the spot


@pytest.mark.parametrize("scanner", [LMS, BACKWARDS])
def test_turns_before_driving_with_half_a_view(scanner):
    """The goal lies behind, an unmapped box is in the way, and the simulator's obstacle stop is off."""
    world = World(name="hall", boundary=HALL.boundary, obstacles=[BOX])
    start, goal = (6.0, 1.5, scanner.mount[2]), (2.0, 1.5)
    simulation = Simulation(Setup(world, scanner, Robot(), start, 0, obstacle_stop=False))
    navigator = Navigator(Robot(), world=HALL, preset=GeodesicPolicy(Robot(), HALL))
    navigator.on_goal(Goal(stamp_ns=0, pose=Pose(x=goal[0], y=goal[1])))
    try:
        while simulation.steps < 400:
            _, truth, scan = simulation.observe()
            assert not truth.contact
            pose = truth.pose.array()
            navigator.on_scan(scan)
            command, status = navigator.step(belief_at(pose, scan.stamp_ns))
            speed = np.hypot(command.twist.vx, command.twist.vy)
            if simulation.steps < 5:  # before it has turned
                assert speed < 0.05
            if status.state == "reached":
                break
            simulation.command(scan.stamp_ns, command.twist)
            simulation.advance()
    finally:
        simulation.close()
    assert status.state == "reached", status


def test_differential_base_that_cannot_see_ahead_is_blocked():
    robot, pose = Robot(drive="differential"), np.array([4.0, 3.0, 0.0])
    policy = GeodesicPolicy(robot, HALL)
    policy.set_goal(np.array([6.0, 3.0]))
    policy.observe(scan_of(BACKWARDS, HALL, pose), belief_at(pose, 0))
    decision = policy.decide(belief_at(pose, 0), np.zeros(3))
    assert decision.reason == BLIND_AHEAD
    assert not decision.action[:2].any()
