"""Motion, safety limits, odometry, furniture, determinism."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import Obstacle
from common.messages.definitions import Twist
from common.robot.robot import Robot
from services.simulator.odometry import Odometer, OdometryNoise
from tests.simulator.driving import FORWARD, HALL, contacts, drive, measurements, speed

LEFT = (1.0, 3.0, 0.0)
BOX, CIRCLE = ({"box": {"center": (5, 3), "size": (1, 1)}}, {"circle": {"center": (6, 3), "radius": 0.5}})


@pytest.mark.parametrize("heading", [0.0, 1.2])
def test_acceleration(make, heading):
    truths = drive(make(start=(2.0, 1.0, heading)), Twist(vx=0.6), 1.5)
    assert speed(truths[-1]) == pytest.approx(0.6, abs=0.01)
    assert abs(truths[-1].twist.vy) < 0.01
    assert np.diff([0.0, *map(speed, truths)]).max() <= Robot().acceleration / 15 * 1.05
    moved = truths[-1].pose.array()[:2] - [2.0, 1.0]
    assert np.arctan2(moved[1], moved[0]) == pytest.approx(heading, abs=0.01)


def test_speed_and_turn_are_clipped(make):
    assert 0.95 < speed(drive(make(), Twist(vx=1e3, vy=1e3), 1.6)[-1]) <= 1.01
    assert drive(make(), Twist(wz=50.0), 1.5)[-1].twist.wz == pytest.approx(Robot().max_turn, abs=0.02)
    fast = Robot(max_speed=3.0, acceleration=8.0)
    assert speed(drive(make(robot=fast, obstacle_stop=False), Twist(vx=3.0), 0.6)[-1]) == pytest.approx(3.0, abs=0.05)


def test_sideways_motion(make):
    assert drive(make(), Twist(vy=0.5), 1)[-1].pose.y > 3.2
    differential = drive(make(robot=Robot(drive="differential")), Twist(vx=0.3, vy=0.5), 1)[-1]
    assert differential.pose.y == pytest.approx(3.0, abs=1e-3)
    assert differential.pose.x > 2.1


@pytest.mark.parametrize(("kind", "repeat"), [("holonomic", True), ("differential", False)])
def test_stop_after_the_last_command(make, kind, repeat):
    """Also if that command is repeated."""
    simulation = make(start=LEFT, robot=Robot(drive=kind))
    last = Twist(vx=1.0, wz=0.3)
    assert speed(drive(simulation, last, 1.3)[-1]) > 0.98
    for _ in range(2):  # a command that is one or two scans late does not trigger braking
        simulation.advance()
        assert speed(simulation.observe()[1]) > 0.98
    drive(simulation, last, 0.3)
    stamp_ns, steps, moving = simulation.stamp_ns - simulation.period_ns, 0, True
    while moving:
        if repeat:
            simulation.command(stamp_ns, last)
        simulation.advance()
        steps, moving = steps + 1, speed(simulation.observe()[1]) >= 1e-3
    assert steps < 7  # one scan period is left for the time since the last command


@pytest.mark.parametrize(
    ("age_ms", "accepted"), [(600, False), (400, True), (0, True), (-1e-6, False)], ids=["old", "late", "now", "future"]
)
def test_stamps_of_commands(make, age_ms, accepted):
    simulation = make()
    for _ in range(15):
        simulation.advance()
    now_ns = simulation.stamp_ns
    assert simulation.command(now_ns - round(age_ms * 1e6), FORWARD) == accepted
    simulation.advance()
    assert (speed(simulation.observe()[1]) > 1e-3) == accepted
    assert simulation.command(now_ns, Twist())
    assert not simulation.command(now_ns - simulation.period_ns, FORWARD)  # older than the last one


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.7, 0.7), (0.0, -1.0)])
def test_obstacle_stop_at_full_speed(make, direction):
    """In all directions that the scanner sees. The 90 deg behind the robot are out of its view, as on the real base."""
    truths = drive(make(start=(4.0, 3.0, 0.0)), Twist(vx=direction[0], vy=direction[1]), 6)
    assert max(map(speed, truths)) > 0.9
    assert not contacts(truths)
    assert speed(truths[-1]) < 0.02
    assert truths[-1].stopped
    gap = float(HALL.clearance([truths[-1].pose.array()[:2]])[0]) - Robot().radius
    assert 0.0 < gap < 0.2  # close, but not touching


def test_moving_away_from_a_wall_is_allowed(make):
    simulation = make(start=(7.72, 3.0, 0.0))  # 1 cm from the wall ahead
    assert drive(simulation, Twist(vx=0.5), 1)[-1].pose.x < 7.73
    assert drive(simulation, Twist(vx=-0.5), 1)[-1].pose.x < 7.5


@pytest.mark.parametrize("radius", [0.105, 0.27, 0.4])
def test_wall_without_the_obstacle_stop(make, radius):
    robot = Robot(radius=radius, max_speed=0.6)
    truths = drive(make(start=(7.0, 3.0, 0.0), robot=robot, obstacle_stop=False), FORWARD, 3)
    assert truths[-1].contact
    assert max(map(speed, truths)) == pytest.approx(0.6, abs=0.01)
    assert speed(truths[-1]) < 0.05
    assert 8 - truths[-1].pose.x == pytest.approx(radius, abs=0.02)


@pytest.mark.parametrize("people", [0, 2])
def test_bytes_depend_on_the_seed(make, people):
    def run(seed):
        rows = measurements(make(seed=seed, people=people), 1, Twist(vx=0.5, vy=0.1, wz=0.4))
        return [message.encode() for row in rows for message in row]

    assert run(3) == run(3)
    assert run(3) != run(4)


def test_odometry_without_drift_is_exact(make):
    start = np.array([2.0, 3.0, 0.7])
    simulation = make(start=tuple(start), drift=OdometryNoise(0, 0, 0, 0))
    drive(simulation, Twist(vx=0.5, vy=0.2, wz=0.5), 2)
    odom, truth, _ = simulation.observe()
    assert odom.pose.array() == pytest.approx(se2.between(start, truth.pose.array()), abs=1e-9)
    assert not odom.covariance.any()


def test_odometry_drift():
    poses, normalised = [np.zeros(3)], []
    for _ in range(30):
        poses.append(se2.compose(poses[-1], np.array([0.03, 0.01, 0.02])))
    for seed in range(200):
        odometer = Odometer(OdometryNoise(), np.random.default_rng(seed))
        for before, after in itertools.pairwise(poses):
            odometer.move(before, after)
        error = odometer.pose - poses[-1]
        normalised.append(error @ np.linalg.solve(odometer.covariance, error))
    assert np.mean(normalised) == pytest.approx(3.0, abs=0.4)  # chi² with 3 degrees of freedom, mean of 200


def test_teleport(make):
    simulation = make()
    before = simulation.observe()[0]
    simulation.teleport(np.array([6.0, 2.0, 1.0]))
    odom, truth, _ = simulation.observe()
    assert odom.pose == before.pose
    assert truth.pose.array() == pytest.approx([6.0, 2.0, 1.0])
    for pose, error in (([7.9, 2, 0], "0.10 m from a wall"), ([9, 9, 0], "inside something, or off the map")):
        with pytest.raises(UserError, match=error):
            simulation.teleport(np.array(pose, float))
    assert simulation.observe()[1].pose == truth.pose


def test_changed_furniture(make):
    simulation = make()

    def ahead():
        return float(simulation.sample(np.array([[2.0, 3.0, 0.0]]), None, None)[0][135])

    assert ahead() == pytest.approx(5.8, abs=1e-3)
    for action, shape, distance in (("add", BOX, 2.3), ("move", CIRCLE, 3.3), ("remove", None, 5.8)):
        simulation.change_obstacle(action, "thing", shape and Obstacle.model_validate(shape))
        assert ahead() == pytest.approx(distance, abs=1e-3)
        assert [o.name for o in simulation.world.obstacles] == (["thing"] if shape else [])


@pytest.mark.parametrize(
    ("action", "name", "center", "error"),
    [
        ("add", "here", (2, 3), "on the robot"),
        ("add", "out", (20, 3), "outside the world"),
        ("add", "boundary", (5, 3), "name of its own"),
        ("move", "nothing", (5, 3), "no obstacle 'nothing'"),
        ("remove", "nothing", (5, 3), "no obstacle 'nothing'"),
    ],
)
def test_impossible_furniture_is_refused(make, action, name, center, error):
    simulation = make()
    with pytest.raises(UserError, match=error):
        simulation.change_obstacle(action, name, Obstacle(circle={"center": center, "radius": 0.3}))
    assert simulation.world.obstacles == []


def test_start_in_a_wall_raises_a_user_error(make):
    with pytest.raises(UserError, match=r"start \(0\.10, 3\.00\) in hall is 0\.10 m from a wall, and the robot needs"):
        make(start=(0.1, 3.0, 0.0))
