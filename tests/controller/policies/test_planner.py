"""Driving in the simulator with the true pose as belief: around walls and unmapped obstacles, without contact."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.world import Obstacle, World, load_world
from common.messages.definitions import Belief, Goal, Pose
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from services.controller.goal_state import Phase
from services.controller.navigator import Navigator
from services.controller.policies.planner import GeodesicPolicy
from services.simulator.simulation import Setup, Simulation

SCANNER = SCANNERS["tim571"].with_beams(271)
DRIVES = ("holonomic", "differential")


def belief_at(pose, stamp_ns, state="tracking", hypotheses=()):
    return Belief(
        stamp_ns=stamp_ns,
        state=state,
        pose=Pose.of(pose),
        xi=np.zeros(3, np.float32),
        free_energy=0,
        accuracy=0,
        hypotheses=list(hypotheses),
    )


def drive(
    world,
    robot,
    start,
    goal,
    limit=900,
    *,
    known=None,
    change=None,
    more=None,
    seed=0,
    stop=True,
    scanner=SCANNER,
    seen=None,
):
    """Drive until the goal is reached. Returns true poses (T, 3), statuses and the number of scans with contact.

    ``known`` is the controller's map, ``stop`` the simulator's obstacle stop, ``change`` a function called before each
    scan, and ``seen`` a function that changes the scan for the controller. ``more`` are further fields of the goal.
    """
    simulation = Simulation(Setup(world, scanner, robot, start, seed, obstacle_stop=stop))
    navigator = Navigator(robot, world=known or world, preset=GeodesicPolicy(robot, known or world))
    navigator.on_goal(Goal(stamp_ns=0, pose=Pose(x=goal[0], y=goal[1], yaw=(more or {}).pop("yaw", 0)), **(more or {})))
    poses, statuses, contacts = [], [], 0
    try:
        while simulation.steps < limit:
            if change is not None:
                change(simulation)
            _, truth, scan = simulation.observe()
            poses.append(truth.pose.array())
            contacts += truth.contact
            navigator.on_scan(seen(scan) if seen else scan)
            command, status = navigator.step(belief_at(poses[-1], scan.stamp_ns))
            statuses.append(status)
            if status.state == "reached" and not np.any(simulation.physics.twist().round(3)):
                break
            simulation.command(scan.stamp_ns, command.twist)
            simulation.advance()
    finally:
        simulation.close()
    return np.array(poses), statuses, contacts


@pytest.mark.parametrize("kind", DRIVES)
@pytest.mark.parametrize("name", ["maze", "office"])
def test_drives_around_walls_without_contact(name, kind):
    world, robot, rng = load_world(name), Robot(drive=kind), np.random.default_rng(3)
    policy = GeodesicPolicy(robot, world)
    for number in range(2):
        start, goal = world.sample_free(2, rng, 0.32)
        field = policy.graph.cost_field(goal)
        shortest = float(np.hypot(*np.diff(field.path(start), axis=0).T).sum())
        poses, statuses, contacts = drive(world, robot, (*start, rng.uniform(-np.pi, np.pi)), goal, seed=number)
        assert statuses[-1].state == "reached", (start, goal, statuses[-1])
        assert contacts == 0
        assert np.hypot(*(poses[-1][:2] - goal)) <= 0.2
        assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() <= 1.1 * shortest + 0.2


@pytest.mark.parametrize("kind", DRIVES)
def test_turns_to_the_heading_of_the_goal(kind):
    world = load_world("corridor")
    heading = {"yaw": 2.0, "yaw_tolerance": 0.1}
    poses, statuses, _ = drive(world, Robot(drive=kind), (3.0, 1.5, 0.0), (5.0, 1.5), more=heading)
    assert statuses[-1].state == "reached"
    assert abs(poses[-1][2] - 2.0) <= 0.1
    turning = [status for status in statuses if "turning into" in status.reason]
    assert turning  # the goal is not reached before the turn ends
    assert {status.state for status in turning} == {"navigating"}


@pytest.mark.parametrize("kind", DRIVES)
def test_drives_around_an_unmapped_box(kind):
    world = World(name="hall", boundary=[(0, 0), (10, 0), (10, 5), (0, 5)])
    box = {"name": "box", "box": {"center": (5, 2.5), "size": (0.6, 1.2)}}
    changed = World(name="hall", boundary=world.boundary, obstacles=[box])
    poses, statuses, contacts = drive(changed, Robot(drive=kind), (1.5, 2.5, 0.0), (8.5, 2.5), known=world)
    assert statuses[-1].state == "reached"
    assert contacts == 0
    assert np.abs(poses[:, 1] - 2.5).max() > 0.8
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() < 9.0


def test_new_box_counts_as_moving_for_one_second():
    hall = World(name="hall", boundary=[(0, 0), (10, 0), (10, 3), (0, 3)])
    far, near = (Obstacle(name="box", box={"center": (x, 1.5), "size": (0.6, 1.2)}) for x in (9.5, 3.9))
    world = hall.model_copy(update={"obstacles": [far]})

    def move(simulation):
        if simulation.steps == 30:
            simulation.change_obstacle("move", "box", near)

    _, statuses, _ = drive(world, Robot(), (1.5, 1.5, 0.0), (8.5, 1.5), 60, known=hall, change=move)
    nearby = [status.reason.split(",")[0] for status in statuses[30:]]
    assert {"waiting: something that may move"} == set(nearby[:15])
    assert not any("may move" in reason for reason in nearby[15:])


def test_waits_at_a_closed_door_until_it_opens():
    walls = [
        {"name": "left", "box": {"center": (5, 1), "size": (0.2, 2)}},
        {"name": "right", "box": {"center": (5, 4.1), "size": (0.2, 1.8)}},
    ]
    known = World(name="door", boundary=[(0, 0), (10, 0), (10, 5), (0, 5)], obstacles=walls)
    door = {"name": "door", "box": {"center": (5, 2.6), "size": (0.1, 1.3)}}
    shut = World(name="door", boundary=known.boundary, obstacles=[*walls, door])

    def change(simulation):
        if simulation.steps == 300:
            simulation.change_obstacle("remove", "door", None)

    poses, statuses, contacts = drive(shut, Robot(), (2.0, 2.5, 0.0), (8.0, 2.5), known=known, change=change)
    blocked = [status for status in statuses[:300] if status.state == "blocked"]
    assert blocked
    assert any("no way" in status.reason for status in blocked)
    assert (poses[:300, 0] < 5).all()
    assert statuses[-1].state == "reached"
    assert contacts == 0


def test_refusal_names_the_nearest_reachable_place():
    walls = [{"name": "wall", "box": {"center": (5, 2.5), "size": (0.2, 5)}}]
    world = World(name="two", boundary=[(0, 0), (10, 0), (10, 5), (0, 5)], obstacles=walls)
    navigator = Navigator(world=world, preset=GeodesicPolicy(Robot(), world))
    navigator.on_goal(Goal(stamp_ns=0, pose=Pose(x=5.0, y=2.5)))
    assert (navigator.goal_state.phase, "is inside something" in navigator.goal_state.reason) == (Phase.REFUSED, True)
    navigator.on_goal(Goal(stamp_ns=0, pose=Pose(x=0.2, y=2.5)))
    assert "is 0.20 m from a wall; the nearest place that can be reached is (0.35, 2." in navigator.goal_state.reason
    # In the other room: refused as soon as it is known in which room the robot is.
    navigator.on_goal(Goal(stamp_ns=0, pose=Pose(x=8.0, y=2.5)))
    simulation = Simulation(Setup(world, SCANNER, Robot(), (2.0, 2.5, 0.0)))
    try:
        _, truth, scan = simulation.observe()
    finally:
        simulation.close()
    navigator.on_scan(scan)
    command, status = navigator.step(belief_at(truth.pose.array(), 0))
    assert status.state == "blocked"
    assert "cannot be reached from here; the nearest place that can be reached is (4.5" in status.reason
    assert not command.twist.array().any()


@pytest.mark.parametrize("kind", DRIVES)
def test_no_contact_with_an_empty_map_and_no_obstacle_stop(kind):
    """Every wall within the boundary is unmapped."""
    world, robot, rng = load_world("maze"), Robot(drive=kind), np.random.default_rng(5)
    empty = World(name="empty", boundary=world.boundary)
    fastest = 0.0
    for number in range(3):
        start, goal = world.sample_free(2, rng, 0.45)
        poses, _, contacts = drive(
            world, robot, (*start, rng.uniform(-np.pi, np.pi)), goal, 200, known=empty, seed=number, stop=False
        )
        assert contacts == 0, (start, goal)
        fastest = max(fastest, np.hypot(*np.diff(poses[:, :2], axis=0).T).max() * 15)
    assert fastest > 0.9  # m/s, so braking was necessary


@pytest.mark.parametrize("kind", DRIVES)
def test_stays_blocked_while_backing_off_from_a_closed_door(kind):
    walls = [
        {"name": "left", "box": {"center": (5, 1), "size": (0.2, 2)}},
        {"name": "right", "box": {"center": (5, 4.1), "size": (0.2, 1.8)}},
    ]
    known = World(name="door", boundary=[(0, 0), (10, 0), (10, 5), (0, 5)], obstacles=walls)
    shut = World(
        name="door",
        boundary=known.boundary,
        obstacles=[*walls, {"name": "door", "box": {"center": (5, 2.6), "size": (0.1, 1.3)}}],
    )
    _, statuses, contacts = drive(shut, Robot(drive=kind), (2.0, 2.5, 0.0), (8.0, 2.5), known=known, limit=600)
    assert contacts == 0
    backing = [status for status in statuses if status.reason == "stuck: backing off"]
    assert {status.state for status in backing} == {"blocked"}
    blocked = sum(status.state == "blocked" for status in statuses)
    # The first 150 scans are the way to the door. Between two recoveries the robot returns to the door.
    assert blocked > 0.4 * (len(statuses) - 150)


def test_backs_off_if_only_the_limits_stop_the_robot():
    """As in a doorway that is free for the planner but not for the limits: the velocity stays zero."""
    policy = GeodesicPolicy(Robot(), load_world("corridor"))
    policy.set_goal(np.array([15.0, 1.5]))
    reasons = [
        policy.decide(belief_at(np.array([5.0, 1.5, 0.0]), k * 66_000_000), np.zeros(3)).reason for k in range(60)
    ]
    assert reasons[0] == ""
    assert reasons[-1] == "stuck: backing off"


@pytest.mark.parametrize("kind", DRIVES)
def test_drives_slowly_while_not_localised(kind):
    world, robot = load_world("office"), Robot(drive=kind)
    simulation = Simulation(Setup(world, SCANNER, robot, (6.0, 4.0, 0.0), 0))
    navigator = Navigator(robot, world=world, preset=GeodesicPolicy(robot, world))
    navigator.on_goal(Goal(stamp_ns=0, pose=Pose(x=15.0, y=4.0)))
    speeds = []
    try:
        for _ in range(120):
            scan = simulation.observe()[2]
            navigator.on_scan(scan)
            command, status = navigator.step(belief_at(np.array([6.0, 4.0, 0.0]), scan.stamp_ns, "localising"))
            speeds.append(float(np.hypot(command.twist.vx, command.twist.vy)))
            simulation.command(scan.stamp_ns, command.twist)
            simulation.advance()
    finally:
        simulation.close()
    assert status.state == "exploring"
    assert 0.2 < max(speeds) <= 0.5 + 1e-6
