"""People in the simulator: rays, contacts, the obstacle stop, and the map."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import Obstacle, World
from common.messages.definitions import Twist
from common.robot.robot import Robot
from services.simulator.people import PERSON_RADIUS_M
from tests.simulator.driving import ALLEY, FORWARD, SCANNER, contacts, drive, measurements, speed

EXACT = SCANNER.model_copy(update={"sigma": 0.0})
HALL = World(name="hall", boundary=[(0, 0), (14, 0), (14, 10), (0, 10)], start={"x": 1, "y": 1})
TOUCH = PERSON_RADIUS_M + Robot().radius


def distance(truth) -> float:
    """Distance in m between the centres of the robot and the nearest person."""
    return float(np.hypot(*(truth.people - truth.pose.array()[:2]).T).min())


def test_rays_hit_people(make):
    simulation, hits = make("office", EXACT, people=10, seed=4), 0
    office = simulation.world
    for _, truth, scan in measurements(simulation, 10, Twist(vx=0.3, wz=0.2))[::5]:
        solid = [
            Obstacle(name=f"person-{i}", circle={"center": tuple(place.tolist()), "radius": PERSON_RADIUS_M})
            for i, place in enumerate(truth.people)
        ]
        laser = se2.compose(truth.pose.array()[None], np.array(EXACT.mount))
        peopled = office.with_obstacles([*office.obstacles, *solid])
        # Where a beam grazes an edge, anything within 1 mm of it is a correct result.
        sideways = 1e-3 / scan.ranges.astype(float)
        near = np.stack([peopled.ray_distances(laser, scan.angles() + k * sideways)[0] for k in (-1, -0.5, 0, 0.5, 1)])
        assert ((near.min(axis=0) - 1e-3 <= scan.ranges) & (scan.ranges <= near.max(axis=0) + 1e-3)).all()
        hits += int((near[2] < office.ray_distances(laser, scan.angles())[0] - 0.01).sum())
    assert hits > 400


def test_beams_that_hit_people(make):
    plain, peopled = (measurements(make("office", people=count, seed=7), 5) for count in (0, 6))
    shorter = 0
    for (odom, truth, scan), (odom_2, truth_2, scan_2) in zip(plain, peopled, strict=True):
        assert odom == odom_2
        assert len(truth.people) == 0
        assert truth.model_copy(update={"people": truth_2.people}) == truth_2
        differ = scan.ranges != scan_2.ranges
        assert (scan_2.ranges[differ] < scan.ranges[differ]).all()
        shorter += int(differ.sum())
    assert 0 < shorter < 0.5 * len(plain) * SCANNER.beams


def test_samples_without_people(make):
    plain, peopled = make("office"), make("office", people=30)
    poses = np.column_stack([plain.world.sample_free(40, np.random.default_rng(1), 0.3), np.zeros(40)])
    assert np.array_equal(plain.sample(poses, None, 5), peopled.sample(poses, None, 5))
    assert peopled.world == plain.world
    assert (plain.observe()[2].ranges != peopled.observe()[2].ranges).any()


def test_people_do_not_touch_a_standing_robot(make):
    truths = drive(make(ALLEY, EXACT.with_beams(2), people=2, start=(8.0, 0.45, 0.0), seed=3), Twist(), 45)
    assert 0.4 < min(map(distance, truths)) - TOUCH < 0.6
    assert not contacts(truths)
    assert truths[-1].pose.array() == pytest.approx([8.0, 0.45, 0.0], abs=1e-4)


def test_contact_with_a_standing_person(make):
    settings = {"people": 1, "start": (0.5, 0.45, 0.0), "people_speed": 0.0, "obstacle_stop": False}
    truths = drive(make(ALLEY, EXACT.with_beams(2), **settings), FORWARD, 16)
    first = next(truth for truth in truths if truth.contact)
    assert not truths[0].contact
    assert [distance(first), distance(truths[-1])] == pytest.approx([TOUCH, TOUCH], abs=0.02)


def test_obstacle_stop_before_standing_people(make):
    """The robot drives at 1 m/s straight at one person after the other, head on and grazing in turn."""
    simulation = make(HALL, people=12, people_speed=0.0, seed=1)
    stopped, fastest = 0, 0.0
    for number, place in enumerate(simulation.people.places.copy()):
        pose = np.array([*(place - [2.2, 0.25 * (number % 2)]), 0.0])
        if simulation.placement_error(pose) or np.hypot(*(simulation.people.places - pose[:2]).T).min() < 0.9:
            continue
        simulation.teleport(pose)
        truths = drive(simulation, FORWARD, 3.5)
        assert not contacts(truths)
        fastest = max(fastest, *map(speed, truths))
        stopped += speed(truths[-1]) < 0.05
    assert stopped > 3
    assert fastest > 0.9


@pytest.mark.parametrize("kind", ["holonomic", "differential"])
def test_obstacle_stop_among_walking_people(make, kind):
    """The robot drives at 1 m/s among ten people, turning on the spot when stopped."""
    simulation, rng = make("office", people=10, seed=1, robot=Robot(drive=kind)), np.random.default_rng(0)
    turn, driven = 0.0, 0.0
    for _ in range(10 * 15):
        (truth,) = drive(simulation, Twist(vx=1.0, wz=turn), 1 / 15)
        assert not truth.contact
        driven += truth.twist.vx / 15
        held = truth.stopped and truth.twist.vx < 0.05
        turn = (turn or float(rng.choice([-1.5, 1.5]))) if held else 0.0
    assert driven > 2.7


def test_teleport_onto_a_person_moves_them(make):
    simulation = make("office", people=10, seed=2)
    drive(simulation, Twist(), 3)
    target = simulation.people.places[0].copy()
    simulation.teleport(np.array([*target, 0.0]))
    assert np.hypot(*(simulation.people.places[0] - target)) >= 1.5
    assert distance(simulation.observe()[1]) > TOUCH
    assert not contacts(drive(simulation, Twist(), 3))


def test_furniture_on_a_person(make):
    simulation = make(HALL, people=3, seed=2)
    drive(simulation, Twist(), 2)
    place = tuple(simulation.people.places[1].tolist())
    simulation.change_obstacle("add", "box", Obstacle(box={"center": place, "size": (1, 1)}))
    people = np.concatenate([truth.people for truth in drive(simulation, Twist(), 10)])
    assert simulation.world.clearance(people).min() >= PERSON_RADIUS_M - 1e-6
