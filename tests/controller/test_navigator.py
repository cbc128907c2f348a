"""The navigator: goals, limits and statuses."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.shapes import Obstacle
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from services.controller.navigator import Navigator
from services.controller.policies.planner import GeodesicPolicy
from tests.controller.driving import PERIOD_NS, PERIOD_S, belief, box, drive, goal, path_length, room, scan, session

ROOM = room(10, 4)


@pytest.fixture
def navigator():
    made = Navigator(world=ROOM)
    made.on_goal(goal(8.5, 2))
    return made


@pytest.mark.parametrize("yaw", [0.0, -2.0])
def test_goal_is_reached(yaw):
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(8.5, 1.5))
    log = session(navigator, [1.5, 2.5, yaw], [None] * 270, ROOM)
    command, status, pose = log[-1]
    assert status.state == "reached"
    assert np.hypot(*(pose[:2] - [8.5, 1.5])) <= 0.02
    assert not command.twist.array().any()
    assert path_length([pose for *_, pose in log]) < 1.02 * np.hypot(7, 1)


@pytest.mark.parametrize(
    ("covariance", "reason"),
    [
        (None, "believed within 0.02 m of the goal"),  # as by preset paper
        (np.diag([1e-6, 1e-6, 1e-6]), "within 0.02 m of the goal"),
        (np.diag([4e-4, 1e-6, 1e-6]), "within 0.02 m of the goal, but the pose is only known to 0.04 m"),
    ],
)
def test_reason_of_arrival(covariance, reason):
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(2, 2))
    for k in range(3):
        navigator.on_scan(scan(k * PERIOD_NS, [2, 2, 0], ROOM))
        at_goal = belief(k * PERIOD_NS, [2, 2, 0]).model_copy(update={"covariance": covariance})
        _, status = navigator.step(at_goal)
    assert (status.state, status.reason) == ("reached", reason)


def test_robot_stands_when_the_goal_is_reached():
    navigator = Navigator(chosen_policy=GeodesicPolicy(Robot(), ROOM), world=ROOM)
    navigator.on_goal(goal(3, 2, yaw=-2, yaw_tolerance=0.05))
    log = session(navigator, [1.5, 2.5, 2], [None] * 150, ROOM)
    assert len({tuple(pose) for _, status, pose in log if status.state == "reached"}) == 1


@pytest.mark.parametrize("kind", ["holonomic", "differential"])
def test_latency_of_several_scans(kind):
    """Several commands are still to take effect when the next one is chosen."""
    scans = []
    for latency in (0.0, 0.3):
        poses, statuses, contacts = drive(ROOM, Robot(drive=kind, latency=latency), (1.5, 2.5, 2.0), goal(8.5, 1.5))
        assert (statuses[-1].state, contacts) == ("reached", 0)
        scans.append(len(poses))
    assert scans[1] < scans[0] + 20  # the latency at the start, at the end, and of the turn


@pytest.mark.parametrize(("latency", "scanner"), [(0.1, "tim571"), (0.3, "tim571"), (0.0, "rplidar-a1")])
def test_heading_at_the_goal_with_late_or_rare_commands(latency, scanner):
    to = goal(2.0, 1.5, yaw=2.0, yaw_tolerance=np.deg2rad(2))
    robot = Robot(latency=latency)
    poses, statuses, _ = drive(room(5, 3), robot, (1.0, 1.5, 0.0), to, 300, scanner=SCANNERS[scanner].with_beams(135))
    assert statuses[-1].state == "reached"
    assert abs(se2.wrap(poses[-1, 2] - 2.0)) < np.deg2rad(2.5)


def test_corridor_that_is_longer_than_the_range():
    """The robot drives through the middle, from which it does not see where it is along the corridor."""
    scanner = SCANNERS["rplidar-a1"]
    _, statuses, _ = drive(room(30, 2), Robot(), (2.0, 1.0, 0.0), goal(28.0, 1.0), 220, scanner=scanner)
    assert statuses[-1].state == "reached"


def test_fast_robot_and_a_person():
    """It has nearly stopped when a person who approaches at 1 m/s is near."""
    walked = []

    def person(x):
        return {"name": "person", "circle": {"center": (x, 2.5), "radius": 0.25}}

    def walk(simulation):
        walked.append(max(20.0 - simulation.steps * PERIOD_S, simulation.physics.pose()[0] + 0.7))
        simulation.change_obstacle("move", "person", Obstacle.model_validate(person(walked[-1])))

    hall, robot = room(30, 5, person(20.0)), Robot(max_speed=2.0, acceleration=1.0)
    poses, _, _ = drive(hall, robot, (2.0, 2.5, 0.0), goal(28.0, 2.5), 110, known=room(30, 5), change=walk)
    speed = np.hypot(*np.diff(poses[:, :2], axis=0).T) / PERIOD_S
    near = int(np.argmax(np.hypot(np.array(walked) - poses[:, 0], 2.5 - poses[:, 1]) < 0.8))
    assert speed[:near].max() > 1.5
    assert 0.0 < speed[near - 1] < 0.2


def test_stamps_of_commands():
    command, status = Navigator().step(belief(123, [1, 1, 0]))
    assert command.stamp_ns == status.stamp_ns == 123
    assert (status.state, command.twist.array().any()) == ("idle", False)


@pytest.mark.parametrize(("x", "y", "reason"), [(20, 20, "inside something"), (0.1, 2, "is 0.10 m from a wall")])
def test_goal_in_a_wall_is_refused(x, y, reason):
    navigator = Navigator(world=ROOM)
    navigator.on_goal(goal(x, y))
    ((command, status, _),) = session(navigator, [1.5, 2, 0], [None], ROOM)
    assert (status.state, status.refused, command.twist.array().any()) == ("blocked", True, False)
    assert reason in status.reason
    assert navigator.stop_without_belief(0, "no belief")[1].reason == status.reason


def test_goal_where_the_robot_stands():
    """It is accepted, although it is so near to a wall that others are refused there."""
    navigator = Navigator(chosen_policy=GeodesicPolicy(Robot(), ROOM), world=ROOM)
    session(navigator, [5, 0.275, 0], [None], ROOM)
    navigator.on_goal(goal(5, 0.265))
    ((command, status, _),) = session(navigator, [5, 0.275, 0], [None], ROOM, first=1)
    assert (status.state, command.twist.array().any()) == ("reached", False)
    navigator.on_goal(goal(6, 0.265))
    assert "m from a wall" in navigator.status(0).reason


def test_back_near_the_goal_after_being_lost():
    """The time without a pose is no time without progress."""
    navigator = Navigator(chosen_policy=GeodesicPolicy(Robot(), ROOM), world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    session(navigator, [8.4, 2, 0], [None], ROOM)
    session(navigator, [8.4, 2, 0], [None] * 60, ROOM, first=1, state="lost")
    log = session(navigator, [8.3, 2, 0], [None] * 30, ROOM, first=61)
    assert not any(status.refused for _, status, _ in log)
    assert log[-1][1].state == "reached"


def test_stands_at_the_goal_of_the_best_guess():
    """Without the terms of information, a robot waits there until the belief is no longer ambiguous."""
    navigator = Navigator(chosen_policy=GeodesicPolicy(Robot(), ROOM, epistemic=False), world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    log = session(navigator, [8.495, 2, 0], [None] * 90, ROOM, state="ambiguous")
    assert not any("refused" in status.reason for _, status, _ in log)
    assert np.hypot(*(log[-1][2][:2] - [8.5, 2])) < 0.02
    _, status, _ = session(navigator, log[-1][2], [None] * 5, ROOM, first=90)[-1]
    assert status.state == "reached"


@pytest.mark.parametrize("state", ["localising", "lost", "ambiguous"])
def test_stands_until_localised(navigator, state):
    ((command, status, _),) = session(navigator, [1.5, 2, 0], [None], ROOM, state=state)
    assert not command.twist.array().any()
    assert state in status.reason
    assert (status.state == "lost") == (state == "lost")
    command, status, _ = session(navigator, [1.5, 2, 0], [None] * 4, ROOM, first=1)[-1]
    assert command.twist.vx > 0
    assert status.state == "navigating"


def test_single_lost_scan():
    """The robot brakes for one scan, and drives on."""
    robot = Robot()
    navigator = Navigator(robot, chosen_policy=GeodesicPolicy(robot, ROOM))
    navigator.on_goal(goal(8.5, 2))
    before = session(navigator, [1.5, 2, 0], [None] * 25, ROOM)[-1]
    ((lost, status, pose),) = session(navigator, before[2], [None], ROOM, first=25, state="lost")
    assert status.state == "lost"
    assert lost.twist.vx == pytest.approx(before[0].twist.vx - robot.acceleration * PERIOD_S)
    after = session(navigator, pose, [None], ROOM, first=26)[0]
    assert (after[1].state, after[0].twist.vx) == ("navigating", pytest.approx(before[0].twist.vx, abs=1e-3))


def test_blocked_by_an_obstacle(navigator):
    log = session(navigator, [1.5, 2, 0], [None] * 150, room(10, 4, box(5, 2, 0.2, 3.9)))  # not in its map
    assert log[-1][1].state == "blocked"
    assert "in the way" in log[-1][1].reason
    assert max(pose[0] for *_, pose in log) + Robot().radius < 4.9


def test_stop_without_a_belief(navigator):
    session(navigator, [1.5, 2, 0], [None] * 15, ROOM)
    command, status = navigator.stop_without_belief(5, "no belief")
    assert (command.stamp_ns, status.reason, status.state, status.distance) == (5, "no belief", "lost", None)
    assert not command.twist.array().any()
    command, status, _ = session(navigator, [3, 2, 0], [None] * 5, ROOM, first=20)[-1]
    assert status.state == "navigating"
    assert command.twist.vx > 0


@pytest.mark.parametrize("late", [0, 1, 20])
def test_localising_with_late_beliefs(late):
    """The robot drives in order to localise, although newer scans have come than that of the belief."""
    navigator = Navigator(chosen_policy=GeodesicPolicy(Robot(), ROOM), world=ROOM)
    navigator.on_goal(goal(8.5, 2))
    for number in range(100):
        navigator.on_scan(scan(number * PERIOD_NS, [2, 2, 0], ROOM))
        if number >= late:
            command, status = navigator.step(belief((number - late) * PERIOD_NS, [2, 2, 0], "localising"))
    assert status.state == "exploring", status
    assert command.twist.array().any()


@pytest.mark.parametrize("late", [0, 1, 9])
def test_velocity_after_a_stop(navigator, late):
    """It continues if every scan was answered, as after a pause, and starts from zero if the estimator was late."""
    before = session(navigator, [2.0, 2, 0], [None] * 12, ROOM)[-1]
    for number in range(12, 12 + late):
        navigator.on_scan(navigator._scan.model_copy(update={"stamp_ns": number * PERIOD_NS}))
    assert not navigator.stop_without_belief(11 * PERIOD_NS, "no belief")[0].twist.array().any()
    command, status = navigator.step(belief((11 + max(late, 1)) * PERIOD_NS, before[2]))
    assert status.state == "navigating"
    if late:
        assert 0 < command.twist.vx <= Robot().acceleration * PERIOD_NS * 1e-9 + 1e-9
        assert command.twist.vx < before[0].twist.vx
    else:
        assert command.twist.vx >= before[0].twist.vx > 0.5
