"""What the estimator believes where the surroundings differ from the map, and after the robot was carried away."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry import se2
from common.geometry.world import World, load_world
from lab.accuracy import tasks
from lab.accuracy.scenes import Scene
from lab.integrity.cases import CASES, make_trial
from lab.integrity.maps import noisy_grid, scaled_map
from services.estimator import factory
from services.estimator.factory import EstimatorOptions, ScannerGeometry, load_model, prepare_factory
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.global_seeds import Seeds, thin_places
from services.estimator.precise.hypotheses import NEAR_HEADING_RAD, NEAR_POSITION_M, probability_of_being_near
from services.estimator.precise.local_map import MovedFraction
from services.estimator.precise.motion_model import MotionCandidate
from services.estimator.precise.precision import Precision
from services.estimator.shared.generative_models import Expected, RayCaster

BEAMS, RATE = 271, 15.0
HALL = World(
    name="hall",
    boundary=[(0, 0), (16, 0), (16, 5), (0, 5)],
    obstacles=[
        {"box": {"center": (2.5, 4.2), "size": (0.8, 0.5), "yaw_deg": 15}},
        {"circle": {"center": (5.5, 0.8), "radius": 0.3}},
        {"box": {"center": (9.5, 4.3), "size": (0.7, 0.7), "yaw_deg": 40}},
        {"circle": {"center": (12.0, 0.9), "radius": 0.4}},
        {"box": {"center": (14.6, 2.6), "size": (0.5, 1.2)}},
    ],
)
LEARNED = 8.0  # m: the part of HALL with smaller x was learned
OFFICE = load_world("office")
FURNITURE = {"desk-1", "cabinet", "plant", "table", "copier", "meeting-table", "whiteboard", "coffee-table", "column"}
CORRIDOR_Y = 4.0  # m, along which the office is driven through
CLOSE = np.diag([0.01, 0.01, 0.01])


@dataclass(frozen=True)
class HalfLearned:
    """A model of the hall that was learned only in its western half."""

    world: World = HALL

    def expect(self, lasers, angles):
        whole = RayCaster(self.world).expect(lasers, angles)
        ahead = np.cos(lasers[:, 2:] + angles)
        begins = np.where(ahead > 0, np.maximum(LEARNED - lasers[:, :1], 0) / np.maximum(ahead, 1e-9), np.inf)
        begins = np.where(lasers[:, :1] > LEARNED, 0.0, begins)
        unknown = whole.ranges > begins
        return Expected(
            np.where(unknown, begins, whole.ranges),
            np.where(unknown, np.inf, whole.scale),
            np.where(unknown[..., None], 0.0, whole.jacobian),
        )

    def expect_behind(self, lasers, angles, ranges):
        return RayCaster(self.world).expect_behind(lasers, angles, ranges)


class RoughMap(RayCaster):
    """A map whose surfaces are misplaced by 3 cm (standard deviation), differently in each square metre."""

    def __init__(self, world, seed):
        super().__init__(world)
        self.errors = 0.03 * np.random.default_rng(seed).standard_normal((40, 40))

    def expect(self, lasers, angles):
        expected = super().expect(lasers, angles)
        directions = lasers[:, 2:] + angles
        ranges = np.minimum(expected.ranges, 100.0)  # m, so that no index is infinite
        x, y = lasers[:, :1] + ranges * np.cos(directions), lasers[:, 1:2] + ranges * np.sin(directions)
        error = self.errors[y.astype(int) % 40, x.astype(int) % 40]
        return Expected(expected.ranges + error * expected.slope, expected.scale, expected.jacobian)


def estimator(mapped, real=None, model=None, keep=lambda places: places[:, 0] > -np.inf):
    """An estimator with a map, and a scene in the real world."""
    scene, model = Scene.of(real or mapped, BEAMS, 3), model or RayCaster(mapped)
    places = thin_places(mapped.sample_free(4000, np.random.default_rng(0), 0.05), 0.3)
    return PreciseEstimator(model, Seeds.at(model, places[keep(places)]), np.array(scene.scanner.mount)), scene


def drive(made, scene, path, first=0):
    clean = scene.clean(np.asarray(path))
    return [made.update(scene.observe(scan, (first + k) / RATE)) for k, scan in enumerate(clean)]


def moved(world, names, seed):
    """The world with the named obstacles at other places, but not in the corridor."""
    rng, obstacles = np.random.default_rng(seed), []
    for each in world.obstacles:
        if each.name in names:
            x, y = next(place for place in world.sample_free(100, rng, 0.5) if abs(place[1] - CORRIDOR_Y) > 1)
            obstacles.append({"box": {"center": (x, y), "size": (0.7, 0.5), "yaw_deg": rng.uniform(0, 90)}})
        else:
            obstacles.append(each)
    return World(name="changed", boundary=world.boundary, obstacles=obstacles)


def test_standing_robot():
    """The scans of one place are no new evidence: a hundred of them leave the weights as the first one did."""
    made, scene = estimator(OFFICE)
    path = np.tile([5.5, CORRIDOR_Y, 0.5], (100, 1))
    made.restart(path[0], CLOSE)
    found = drive(made, scene, path[:1])
    evidence = [each.log_evidence for each in made.hypotheses]
    found += drive(made, scene, path[1:], 1)
    assert [each.log_evidence for each in made.hypotheses] == evidence
    assert found[-1].probability == pytest.approx(found[0].probability, abs=1e-3)


@pytest.mark.parametrize("beams", [BEAMS, 1080])
def test_robot_that_stands_in_one_of_two_rooms_alike(beams, monkeypatch):
    """Neither the noise of many beams nor a pause makes it more probable that it was carried to the other room."""
    monkeypatch.setattr(f"{__name__}.BEAMS", beams)
    made, scene = estimator(load_world("twins"))
    here = np.array([[3.0, 2.5, 0.4]])
    made.restart(here[0], CLOSE / 100)
    found = drive(made, scene, np.tile(here, (50, 1)))
    found += drive(made, scene, np.tile(here, (5, 1)), 50 + round(5 * RATE))  # after a pause of 5 s
    assert all(each.state == "tracking" for each in found)


def test_changed_furniture():
    made, scene = estimator(OFFICE, moved(OFFICE, FURNITURE, 1))
    x = np.linspace(1.5, 16.0, 220)
    path = np.column_stack([x, np.full(len(x), CORRIDOR_Y), 0.6 * np.sin(x)])
    made.restart(path[0], CLOSE)
    found = drive(made, scene, path)
    assert all(tasks.is_at(posterior.pose, pose) for posterior, pose in zip(found, path, strict=True))


def test_wrong_map():
    made, scene = estimator(load_world("maze"), OFFICE)
    for start in scene.poses(2):
        made.restart()
        found = drive(made, scene, scene.path(0.7, start=start))
        assert "tracking" not in {posterior.state for posterior in found}


def test_slow_robot_in_the_wrong_map():
    """The same surfaces from almost the same place are no new evidence, although each search finds another pose."""
    trial = make_trial(CASES["wrong-map"], 54002, 0.55)  # the robot moves 0.12 m
    made = prepare_factory(EstimatorOptions(trial.map_world, "precise", "exact"))(ScannerGeometry.of(trial.scanner))
    found = [made.update(observation) for observation in trial.observations]
    assert max(posterior.probability for posterior in found) < 1e-3


def test_a_later_search_keeps_the_evidence():
    """Even if no key scan has shown the map's errors yet, as long as the state was not `tracking`."""
    made, scene = estimator(OFFICE)
    made._map_cell = 0.05
    x = np.linspace(3.0, 5.0, 30)
    path = np.column_stack([x, np.full(len(x), CORRIDOR_Y), np.zeros(len(x))])
    made.restart(path[0], CLOSE)
    drive(made, scene, path[:-1])
    made._precision = Precision.before_first_scan(0.05)
    before = len(made._local_map.scans)
    assert before > 4
    made.track(scene.observe(scene.clean(path[-1:])[0], len(path) / RATE))
    made.search()
    assert len(made._local_map.scans) >= before


def after_one_scan():
    """An estimator in the office after its first scan, this scan, and the only hypothesis."""
    made, scene = estimator(OFFICE)
    made.restart(np.array([3.0, CORRIDOR_Y, 0.0]), CLOSE)
    drive(made, scene, [[3.0, CORRIDOR_Y, 0.0]])
    (hypothesis,) = made.hypotheses
    return made, made._scan[0], hypothesis


def test_alternatives_are_in_the_same_surroundings():
    """An alternative to the best match is no more probable because the hypothesis was in a room that the map lacks."""
    made, view, before = after_one_scan()
    unmapped = np.array([0.0, 0.0, 1.0])
    made.hypotheses = [replace(before, noise_covariance=0.1 * np.eye(3), surroundings=unmapped)]
    motion = MotionCandidate(before.pose, 0.1 * np.eye(3), 1.0)
    found = made._find_alternatives(view, before, motion, [motion])
    assert found
    assert all(np.array_equal(each.surroundings, unmapped) for each in found)


def test_alternatives_explain_the_surfaces_seen_before():
    """These are no new evidence about the place, but about the motion by which the alternatives differ."""
    world = load_world("corridor")
    made, scene = estimator(world)
    path = np.column_stack([np.linspace(3.0, 3.7, 30), np.full(30, 1.45), np.linspace(0.0, -2.2, 30)])
    made.restart(path[0], CLOSE)
    assert drive(made, scene, path)[-1].state == "tracking"
    off = se2.compose(path[-1], np.array([0.3, 0.1, 0.2]))
    made.hypotheses = [replace(made.hypotheses[0], pose=off, noise_covariance=np.diag([0.1, 0.1, 0.03]), velocity=None)]
    found = drive(made, scene, np.tile(path[-1], (6, 1)), len(path) + 25)
    assert found[-1].state == "tracking"


def test_what_a_motion_costs():
    """It costs as much as the scan would fit worse after an expected motion, at most; the best pays for its own, too.

    A motion that costs less is no gain: a jump of odometry is the same at all hypotheses, but costs less where the pose
    is less certain.
    """
    made, view, best = after_one_scan()
    other = replace(best, pose=best.pose + np.array([0.11, 0.0, 0.0]))
    turned = np.array([0.0, 0.0, 0.5])  # there, the scan fits worse, at the other hypothesis by 6.9 nats

    def loss(cost, cost_of_best, expected, expected_of_best):
        """Nats that another hypothesis loses against the best one, with both ``expected`` at these poses."""
        after = copy.deepcopy(made)
        after.hypotheses = [best, other]
        moved = [replace(best, motion_cost=cost_of_best), replace(other, motion_cost=cost)]
        after._weigh_hypotheses(view, moved, [expected_of_best[None], expected], None, 0.1)
        by_x = sorted(after.hypotheses, key=lambda each: each.pose[0])
        return by_x[0].log_evidence - by_x[1].log_evidence

    far, far_from_best = (other.pose + turned)[None], best.pose + turned
    assert loss(0.0, 5.0, far, far_from_best) == pytest.approx(0)
    assert loss(5.0, 0.0, far, far_from_best) == pytest.approx(5)
    assert loss(20.0, 0.0, far, far_from_best) == pytest.approx(6.9, abs=0.1)
    assert loss(20.0, 5.0, far, far_from_best) == pytest.approx(1.9, abs=0.1)
    assert loss(20.0, 5.0, far, best.pose) == pytest.approx(6.9, abs=0.1)
    assert loss(20.0, 0.0, np.concatenate([far, other.pose[None]]), far_from_best) == pytest.approx(0)


@pytest.mark.parametrize("jump", [0.0, 0.15])
def test_hypothesis_that_has_to_jump(jump):
    """It loses against another one in a room alike that stands still."""
    made, scene = estimator(load_world("twins"))
    here = np.array([[3.0, 2.5, 0.4]])
    drive(made, scene, np.tile(here, (3, 1)))
    assert len(made.hypotheses) == 2
    stays, jumps = made.hypotheses
    made.hypotheses = [stays, replace(jumps, pose=jumps.pose + np.array([jump, 0.0, 0.0]))]
    drive(made, scene, here, 3)
    assert (made.hypotheses[0].weight > 0.99) == (jump > 0)


@pytest.fixture(scope="module")
def driven():
    """An estimator after a drive from the learned half to the other one, its scene, and the path."""
    made, scene = estimator(HALL, model=HalfLearned(), keep=lambda places: places[:, 0] < LEARNED)
    x = np.linspace(3.0, 11.5, 130)  # at 1 m/s
    path = np.column_stack([x, 2.5 + 0.3 * np.sin(x), 0.5 * np.sin(0.7 * x)])
    made.restart(path[0], CLOSE)
    found = drive(made, scene, path)
    assert max(np.hypot(*(p.pose - pose)[:2]) for p, pose in zip(found, path, strict=True)) < 0.15
    return made, scene, path


@pytest.mark.parametrize("kidnapped", [False, True])
def test_unlearned_room(driven, kidnapped):
    made, scene, path = copy.deepcopy(driven)
    then = np.tile([2.0, 1.5, 2.0], (20, 1)) if kidnapped else path[::-1]
    found = drive(made, scene, then, len(path))
    assert np.hypot(*(found[-1].pose - then[-1])[:2]) < 0.02
    # In a plain hall, one place seen after a kidnapping is not quite enough for the state tracking.
    assert found[-1].probability > (0.998 if kidnapped else 0.999)


ROOM = [(1.0, 3.4, 0.9, 0.4), (4.2, 0.9, 0.5, 0.9), (2.6, 2.4, 0.3, 0.3)]  # x, y, width, depth of boxes
# What only the eastern room has: a further box, a box elsewhere, a thicker and a wider box
EASTERN_ROOMS = {
    "further": [*ROOM, (4.0, 2.7, 0.35, 0.3)],
    "moved": [*ROOM[:2], (2.6, 2.55, 0.3, 0.3)],
    "thicker": [*ROOM[:2], (2.6, 2.4, 0.3, 0.5)],
    "wider": [(1.0, 3.4, 1.2, 0.4), *ROOM[1:]],
}


@pytest.mark.parametrize("jump", [(0.02, 0.02, 0.02), (0.12, 0.04, 0.05)])
@pytest.mark.parametrize("eastern", EASTERN_ROOMS)
def test_kidnapping_between_similar_rooms(eastern, jump):
    """A robot carried to a room that differs by one box is not taken to be where it was, among new furniture.

    Most of its scan shows surfaces where it has seen some just before, if it ``jump``s a little in its belief.
    """
    boxes = [*ROOM, *((x + 6.0, y, w, d) for x, y, w, d in EASTERN_ROOMS[eastern]), (5.5, 2.0, 0.2, 4.0)]
    obstacles = [{"box": {"center": (x, y), "size": (w, d)}} for x, y, w, d in boxes]
    rooms = World(name="rooms", boundary=[(0, 0), (11.5, 0), (11.5, 4), (0, 4)], obstacles=obstacles)
    made, scene = estimator(rooms)
    west = np.linspace([1.5, 1.4, 0.0], [2.4, 1.4, 0.0], 30)
    made.restart(west[0], CLOSE)
    assert drive(made, scene, west)[-1].state == "tracking"
    east = np.linspace(np.array([8.4, 1.4, 0.0]) + jump, [9.2, 1.44, 0.5], 30)
    found = drive(made, scene, east, len(west))
    off = [np.hypot(*(posterior.pose - pose)[:2]) for posterior, pose in zip(found, east, strict=True)]
    assert all(o < 0.05 for o, posterior in zip(off, found, strict=True) if posterior.state == "tracking")
    assert off[-1] < 0.05
    # The first scan shows nearly all of the room, so later ones add little evidence.
    assert found[-1].state == "tracking" or eastern != "further"


def test_crowd_and_kidnapping():
    """People who gather around the robot and walk past do not contradict the pose; another place does."""
    made, scene = estimator(load_world("maze"))
    people = np.repeat(np.random.default_rng(5).uniform(0.5, 1.0, 12), 20)
    here, there = scene.poses(2)
    made.restart(here, CLOSE / 100)
    clean = scene.clean(here[None])[0]
    for k in range(45):
        ranges = clean.copy()
        crowd = people[: int(min(0.75, 0.02 * k) * len(clean))]
        hidden = (3 * k + np.arange(len(crowd))) % len(clean)
        ranges[hidden] = np.minimum(ranges[hidden], crowd)
        posterior = made.update(scene.observe(ranges, k / RATE))
        assert tasks.is_at(posterior.pose, here), k
    found = drive(made, scene, np.tile(there, (5, 1)), 45)
    assert np.hypot(*(found[-1].pose - there)[:2]) < 0.02


@pytest.mark.parametrize(
    ("people", "speed"),
    [([(31.5, 0.6), (32.6, 1.4)], -0.5), ([(31.2, 0.5), (31.9, 1.0), (32.5, 1.5)], 1.0)],
)
def test_people_who_start_to_walk_together(people, speed):
    """Where only people show the place along a corridor, the robot may drift with them, but not while `tracking`."""
    made, _ = estimator(corridor_with([]), keep=lambda places: abs(places[:, 0] - 30) < 15)
    here = np.array([30.0, 1.0, 0.0])
    made.restart(here, CLOSE / 100)
    for k in range(50):
        walked = speed * max(0, k - 19) / RATE
        scene = Scene.of(corridor_with([(x + walked, y) for x, y in people]), BEAMS, 3)
        found = made.update(scene.observe(scene.clean(here[None])[0], k / RATE))
        assert np.hypot(*(found.pose - here)[:2]) < 0.2 or found.state != "tracking", k
        assert k > 19 or found.state == "tracking", k


@pytest.mark.parametrize("speed", [0.0, 0.8])
def test_how_many_people_walk_is_learned(speed):
    made, _ = estimator(corridor_with([]))
    here = np.array([32.0, 1.0, 0.0])
    made.restart(here, CLOSE / 100)
    for k in range(45):
        people = [(33.0 + speed * k / RATE, 0.5), (37.0 - speed * k / RATE, 1.5)]
        scene = Scene.of(corridor_with(people), BEAMS, 3)
        made.update(scene.observe(scene.clean(here[None])[0], k / RATE))
    learned, prior = made._moved_fraction.probability, MovedFraction().probability
    assert learned > prior if speed else learned < prior


def corridor_with(people):
    """A corridor of 60 m with one column in its middle, and people standing there."""
    column = {"box": {"center": (33.0, 0.1), "size": (0.3, 0.2)}}
    circles = [{"circle": {"center": person, "radius": 0.2}} for person in people]
    return World(name="corridor", boundary=[(0, 0), (60, 0), (60, 2), (0, 2)], obstacles=[column, *circles])


def test_kidnapping_is_no_change_of_the_surroundings():
    """Nothing is learned about how often surfaces change or move."""
    made, scene = estimator(load_world("maze"))
    here, there = scene.poses(2)
    made.restart(here, CLOSE / 100)
    drive(made, scene, np.tile(here, (10, 1)))
    found = drive(made, scene, there[None], 10)[0]
    assert tasks.is_at(found.pose, there)
    assert made._change_rate.remembered == 0
    assert made._moved_fraction.probability == MovedFraction().probability


def test_odometry_with_the_wrong_sign(driven):
    """Where nothing was learned, recent scans show that the robot backs, although its odometry says it drives on."""
    made, scene, path = copy.deepcopy(driven)
    x = np.tile([11.5, 11.1, 10.7, 10.3, 10.7, 11.1], 3)  # at 1 m/s
    there_and_back = np.column_stack([x, 2.5 + 0.3 * np.sin(x), 0.5 * np.sin(0.7 * x)])
    odom = np.zeros(3)
    for k, pose in enumerate(there_and_back):
        ahead, *rest = se2.between(there_and_back[max(k - 1, 0)], pose)
        odom = se2.compose(odom, np.array([abs(ahead), *rest]))
        found = made.update(scene.observe(scene.clean(pose[None])[0], len(path) / RATE + 0.4 * k, odom))
        assert np.hypot(*(found.pose - pose)[:2]) < 0.05, k


def test_motion_from_recent_scans_ignores_the_map(driven):
    """After a pose that the map has pulled aside, recent scans still show how the robot moves."""
    made, scene, path = copy.deepcopy(driven)
    made.hypotheses = [replace(each, pose=each.pose + np.array([0.0, 0.25, 0.05])) for each in made.hypotheses]
    found = drive(made, scene, path[-1:], len(path))[0]
    assert np.hypot(*(found.pose - path[-1])[:2]) < 0.1
    assert not made._change_rate.remembered


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_probability_of_being_near(seed):
    """Exact where the covariance is round, and never too high: the truth is sampled around the hypothesis."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 1, (3, 3)) * np.exp(rng.uniform(-4, 0))
    sigma, yaw = np.exp(rng.uniform(-3, 0)), np.exp(rng.uniform(-4, -1))
    for covariance, exact in ((root @ root.T + 1e-6 * np.eye(3), False), (np.diag([sigma, sigma, yaw]) ** 2, True)):
        off = rng.multivariate_normal(np.zeros(3), covariance, 20_000)
        near = (np.hypot(off[:, 0], off[:, 1]) < NEAR_POSITION_M) & (np.abs(off[:, 2]) < NEAR_HEADING_RAD)
        found = probability_of_being_near(covariance)
        assert found < near.mean() + 0.02
        if exact:
            assert found == pytest.approx(near.mean(), abs=0.02)


@pytest.mark.parametrize(
    "cupboard",
    [{"box": {"center": (6.0, 2.5), "size": (2.0, 1.6)}}, {"circle": {"center": (6.0, 2.5), "radius": 0.9}}],
    ids=["box", "round"],
)
def test_unknown_start_where_a_cupboard_was_removed(cupboard):
    mapped = World(name="hall", boundary=HALL.boundary, obstacles=[*HALL.obstacles, cupboard])
    scene = Scene.of(HALL, BEAMS, 3)
    made = prepare_factory(EstimatorOptions(mapped, "precise", "exact"))(ScannerGeometry.of(scene.scanner))
    for truth in np.array([[6.0, 2.5, 0.3], [6.1, 2.4, -2.0]]):
        made.restart()
        found = drive(made, scene, truth[None])[0]
        assert tasks.is_at(found.pose, truth)
        assert found.state == "tracking"


@pytest.mark.parametrize("there", [(5.05, 4.47, 0.48), (4.77, 3.81, 0.57)])
def test_carried_nearby(there):
    """A robot that was carried so little that the scan matches at once is tracked at once, too."""
    made, scene = estimator(OFFICE)
    here = np.array([5.5, CORRIDOR_Y, 0.5])
    made.restart(here, CLOSE)
    drive(made, scene, np.tile(here, (10, 1)))
    found = drive(made, scene, np.tile(there, (5, 1)), 10)
    assert found[-1].state == "tracking"
    assert tasks.is_at(found[-1].pose, np.array(there))


def test_map_error_of_the_first_scan():
    """In most places, the first scan shows that the map is 1 % larger; at a few the pose absorbs the difference."""
    made, scene = estimator(scaled_map(OFFICE, 1.01), OFFICE)
    errors = []
    for x in np.linspace(2.0, 14.0, 15):
        truth = np.array([x, CORRIDOR_Y, 0.3])
        made.restart(truth * [1.01, 1.01, 1.0], CLOSE / 4)
        found = drive(made, scene, truth[None])[0]
        off = (found.pose - truth * [1.01, 1.01, 1.0])[:2]
        errors.append(off @ np.linalg.solve(found.covariance[:2, :2], off))
    assert np.mean(np.array(errors) < 25) > 0.8, errors
    assert np.median(errors) < 12, errors
    assert np.mean(errors) < 40, errors


@pytest.mark.parametrize("seed", [3527019, 3527028])
def test_map_that_is_as_exact_as_assumed(seed):
    """It is tracked from the first scan, even if this scan alone made larger errors more probable."""
    trial = make_trial(CASES["noisy-map"], seed, 0.55)
    made = prepare_factory(EstimatorOptions(trial.map_world, "precise", "exact"))(ScannerGeometry.of(trial.scanner))
    made.restart(*trial.start)
    found = [made.update(observation) for observation in trial.observations]
    assert found[0].state == "tracking"
    assert min(each.probability for each in found) > 0.998  # below 0.4 if the larger errors are thought improbable


def test_start_near_a_wrong_match():
    """Half of the furniture was moved. A pose 0.3 m off fits worse, but all searches from a known start ended there."""
    trial = make_trial(CASES["moved-50"], 3553000, 0.05)
    made = prepare_factory(EstimatorOptions(trial.map_world, "precise", "exact"))(ScannerGeometry.of(trial.scanner))
    made.restart(*trial.start)
    assert tasks.is_at(made.update(trial.observations[0]).pose, trial.truths[0])


@pytest.mark.parametrize(("assumed", "improbable"), [(0.0, True), (0.1, False)])
def test_errors_larger_than_assumed_are_improbable(assumed, improbable):
    """When the first scan is searched again, with the errors of the map that it shows."""
    made, scene = estimator(OFFICE, model=RoughMap(OFFICE, 1))
    here = np.array([3.0, CORRIDOR_Y, 0.0])
    made.restart(here, CLOSE)
    made.track(scene.observe(scene.clean(here[None])[0], 0.0))
    view = replace(made._scan[0], log_map_error_prior=-9.0)
    made._search_for_hypotheses([view])
    again = made._search_with_map_error(view, assumed, (here, CLOSE))
    assert again.map_error > view.map_error
    assert again.log_map_error_prior == (-9.0 if improbable else 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_unknown_start_in_a_rough_map(seed):
    """At the first scan, the map may be less exact than the model states."""
    made, scene = estimator(OFFICE, model=RoughMap(OFFICE, seed))
    for truth in scene.poses(2):
        made.restart()
        assert tasks.is_at(drive(made, scene, truth[None])[0].pose, truth)


def test_surfaces_in_the_cells_of_a_grid():
    """A grid's cells begin half a cell in front of the real walls on average, and the covariance contains the rest."""
    scene = Scene.of(HALL, BEAMS, 3)
    make = prepare_factory(EstimatorOptions(noisy_grid(scene), "precise", "exact"))
    errors, normalised = [], []
    for truth in scene.poses(15):
        made = make(ScannerGeometry.of(scene.scanner))
        made.restart(truth, CLOSE)
        found = drive(made, scene, truth[None])[0]
        errors.append((found.pose - truth)[:2])
        normalised.append(errors[-1] @ np.linalg.solve(found.covariance[:2, :2], errors[-1]))
    assert np.sqrt((np.array(errors) ** 2).sum(axis=1).mean()) < 0.02
    assert np.mean(normalised) < 4.5


@pytest.mark.parametrize("measured", [False, True])
def test_field_learned_on_a_grid(monkeypatch, measured):
    """A field that was learned from the robot's scans has no cells, though its map is a grid."""
    grid = noisy_grid(Scene.of(HALL, BEAMS, 3))
    model, seeds, _ = load_model(EstimatorOptions(grid, model="exact"), grid)
    scanner = Scene.of(HALL, BEAMS, 3).scanner
    card = SimpleNamespace(measured=measured, calibration=None, inflation=1.0, world=grid, scanner=scanner)
    monkeypatch.setattr(factory, "load_model", lambda *_: (model, seeds, card))
    made = prepare_factory(EstimatorOptions(grid))(ScannerGeometry.of(scanner))
    assert (Precision.before_first_scan(0.0) == made._precision) is measured


def test_heading_of_a_kidnapping():
    """A robot that was turned on the spot is found again."""
    made, scene = estimator(OFFICE)
    here = np.array([7.5, CORRIDOR_Y, 0.0])
    made.restart(here, CLOSE)
    drive(made, scene, np.tile(here, (3, 1)))
    turned = np.array([*here[:2], se2.wrap(2.5)])
    found = drive(made, scene, np.tile(turned, (10, 1)), 3)
    assert tasks.is_at(found[-1].pose, turned)
    assert found[-1].state == "tracking"
