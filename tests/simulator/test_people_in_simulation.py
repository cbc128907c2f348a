"""People in the simulator: rays, contacts, the obstacle stop, and the map."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import Circle, Obstacle, World, load_world
from common.messages.definitions import Twist
from common.robot.base import Robot
from common.robot.scanner import SCANNERS
from services.simulator.people import PERSON_RADIUS_M
from services.simulator.simulation import Setup, Simulation

SCANNER = SCANNERS["tim571"].with_beams(271)
EXACT = SCANNER.model_copy(update={"sigma": 0.0})
ALLEY = World(name="alley", boundary=[(0, 0), (16, 0), (16, 0.9), (0, 0.9)])
HALL = World(name="hall", boundary=[(0, 0), (14, 0), (14, 10), (0, 10)])
STANDING = Twist()


@pytest.fixture
def make():
    made = []

    def build(world="office", people=10, scanner=SCANNER, **rest) -> Simulation:
        world = load_world(world) if isinstance(world, str) else world
        made.append(Simulation(Setup(world, scanner, people=people, **rest)))
        return made[-1]

    yield build
    for simulation in made:
        simulation.close()


def run(simulation, seconds, twist=STANDING):
    """Odometry, truth and scan of each period, including the first."""
    seen = [simulation.observe()]
    for _ in range(int(seconds * 15)):
        simulation.command(simulation.stamp_ns, twist)
        simulation.advance()
        seen.append(simulation.observe())
    return seen


def distance(truth) -> float:
    """Distance in m between the centres of the robot and the nearest person."""
    return float(np.hypot(*(truth.people - truth.pose.array()[:2]).T).min())


def test_rays_hit_people(make):
    simulation = make(scanner=EXACT, seed=4)
    hits = 0
    for _, truth, scan in run(simulation, 12, Twist(vx=0.3, wz=0.2))[::5]:
        solid = [
            Obstacle(name=f"person-{i}", circle=Circle(center=(float(x), float(y)), radius=PERSON_RADIUS_M))
            for i, (x, y) in enumerate(truth.people)
        ]
        office = simulation.world
        peopled = World(name="peopled", boundary=office.boundary, obstacles=[*office.obstacles, *solid])
        laser = se2.compose(truth.pose.array()[None], np.array(EXACT.mount))
        exact = partial(peopled.ray_distances, laser)
        # Where a beam grazes an edge, anything within 1 mm of it is a correct result.
        around = np.stack([exact(scan.angles() + 1e-3 / scan.ranges.astype(float) * k)[0] for k in (-1, -0.5, 0.5, 1)])
        right = exact(scan.angles())[0]
        low, high = np.minimum(right, around.min(axis=0)) - 1e-3, np.maximum(right, around.max(axis=0)) + 1e-3
        assert ((low <= scan.ranges) & (scan.ranges <= high)).all()
        hits += int((right < office.ray_distances(laser, scan.angles())[0] - 0.01).sum())
    assert hits > 500


def test_people_change_only_the_beams_that_hit_them(make):
    plain, peopled = (run(make(people=count, seed=7), 10) for count in (0, 6))
    shorter = 0
    for (odom, truth, scan), (odom_2, truth_2, scan_2) in zip(plain, peopled, strict=True):
        assert odom == odom_2
        assert truth.model_copy(update={"people": truth_2.people}) == truth_2
        differ = scan.ranges != scan_2.ranges
        assert (scan_2.ranges[differ] < scan.ranges[differ]).all()
        shorter += int(differ.sum())
    assert len(plain[0][1].people) == 0
    assert 0 < shorter < 0.5 * sum(len(scan.ranges) for *_, scan in plain)


def test_same_seed_same_bytes(make):
    def once(seed):
        return [message.encode() for row in run(make(seed=seed), 4, Twist(vx=0.5, wz=0.2)) for message in row]

    assert once(3) == once(3)
    assert once(3) != once(4)


def test_samples_and_the_world_do_not_contain_people(make):
    plain, peopled = make(people=0), make(people=30)
    poses = np.column_stack([plain.world.sample_free(40, np.random.default_rng(1), 0.3), np.zeros(40)])
    for _ in range(3):
        assert np.array_equal(plain.sample(poses, None, 5), peopled.sample(poses, None, 5))
        run(peopled, 1)
    assert peopled.world == plain.world
    assert (plain.observe()[2].ranges != peopled.observe()[2].ranges).any()


def test_people_do_not_touch_a_standing_robot(make):
    simulation = make(ALLEY, people=2, start=(8.0, 0.45, 0.0), seed=3)
    truths = [truth for _, truth, _ in run(simulation, 45)]
    nearest = min(map(distance, truths)) - PERSON_RADIUS_M - Robot().radius
    assert 0.4 < nearest < 0.6
    assert not any(truth.contact for truth in truths)
    assert truths[-1].pose.array() == pytest.approx([8.0, 0.45, 0.0], abs=1e-4)


def test_contact_with_a_standing_person(make):
    simulation = make(ALLEY, people=1, start=(0.5, 0.45, 0.0), people_speed=0.0, obstacle_stop=False)
    truths = [truth for _, truth, _ in run(simulation, 16, Twist(vx=1.0))]
    assert any(truth.contact for truth in truths)
    assert distance(truths[-1]) == pytest.approx(PERSON_RADIUS_M + Robot().radius, abs=0.02)
    assert not truths[0].contact
    first = next(truth for truth in truths if truth.contact)
    assert distance(first) == pytest.approx(PERSON_RADIUS_M + Robot().radius, abs=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_obstacle_stop_before_standing_people(make, seed):
    """Drive at 1 m/s straight at one person after the other."""
    simulation = make(HALL, people=12, start=(1.0, 1.0, 0.0), people_speed=0.0, seed=seed)
    stopped, fastest = 0, 0.0
    for place in simulation.people.places.copy():
        before = place - [2.2, 0.25 * (seed - 1)]  # head on, and grazing
        pose = np.array([*before, 0.0])
        if simulation.placement_error(pose) or np.hypot(*(simulation.people.places - before).T).min() < 0.9:
            continue
        simulation.teleport(pose)
        truths = [truth for _, truth, _ in run(simulation, 3.5, Twist(vx=1.0))]
        assert not any(truth.contact for truth in truths)
        fastest = max(fastest, *(float(np.hypot(t.twist.vx, t.twist.vy)) for t in truths))
        stopped += np.hypot(truths[-1].twist.vx, truths[-1].twist.vy) < 0.05
    assert stopped > 3
    assert fastest > 0.9


@pytest.mark.parametrize("drive", ["holonomic", "differential"])
def test_obstacle_stop_among_walking_people(make, drive):
    """Drive at 1 m/s among ten people, turning on the spot when stopped."""
    simulation = make(people=10, seed=1, robot=Robot(drive=drive))
    rng, turn, contacts, gone = np.random.default_rng(0), 0.0, 0, 0.0
    simulation.observe()
    for _ in range(30 * 15):
        simulation.command(simulation.stamp_ns, Twist(vx=1.0, wz=turn))
        simulation.advance()
        truth = simulation.observe()[1]
        gone += truth.twist.vx / 15
        contacts += truth.contact
        held = truth.stopped and truth.twist.vx < 0.05
        turn = (turn or float(rng.choice([-1.5, 1.5]))) if held else 0.0
    assert contacts == 0
    assert gone > 8


def test_teleport_onto_a_person_moves_them(make):
    simulation = make(seed=2)
    run(simulation, 3)
    target = simulation.people.places[0].copy()
    clear = simulation.placement_error(np.array([*target, 0.0])) is None
    assert clear
    simulation.teleport(np.array([*target, 0.0]))
    assert np.hypot(*(simulation.people.places[0] - target)) >= 1.5
    truth = simulation.observe()[1]
    assert distance(truth) > PERSON_RADIUS_M + Robot().radius
    assert not any(truth.contact for _, truth, _ in run(simulation, 3))


def test_furniture_put_onto_a_person_moves_them(make):
    simulation = make(HALL, people=3, start=(1.0, 1.0, 0.0), seed=2)
    run(simulation, 2)
    place = simulation.people.places[1]
    simulation.change_obstacle(
        "add", "box", Obstacle.model_validate({"box": {"center": tuple(map(float, place)), "size": (1, 1)}})
    )
    for _, truth, _ in run(simulation, 15):
        assert simulation.world.clearance(truth.people).min() >= PERSON_RADIUS_M - 1e-6
