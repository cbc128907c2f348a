"""Many robots, one estimator process: the same numbers as alone, in turns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from common.robot.scanner import SCANNERS
from services.estimator.factory import Choice, Geometry, prepare
from services.estimator.multi_robot import SHARE, Fleet
from services.estimator.shared.interface import Observation

BEAMS = 64
WORLD = load_world("corridor")
SCANNER = SCANNERS["tim571"].with_beams(BEAMS)
GEOMETRY = Geometry(SCANNER.angles(), np.array(SCANNER.mount), SCANNER.range_max)
HEADING = np.pi / 2  # the one preset paper knows
STARTS = {f"r{k}": np.array([3.0 + 2 * k, 1.3 + 0.1 * k, HEADING]) for k in range(6)}


def observations(pose, seed, count, first=0):
    """Of a robot that drifts along."""
    rng = np.random.default_rng(seed)
    poses = pose + np.outer(np.arange(count), [0.02, 0.005, 0.0])
    clean = WORLD.ray_distances(se2.compose(poses, SCANNER.mount), SCANNER.angles())
    noisy = clean + 0.02 * rng.standard_normal(clean.shape)
    return [Observation(row, SCANNER.angles(), SCANNER.range_max, (first + k) / 15) for k, row in enumerate(noisy)]


@pytest.fixture(scope="module")
def factories():
    return {name: prepare(Choice("corridor", name, seed=3)) for name in ("precise", "paper", "particle-filter")}


@pytest.fixture(scope="module")
def geometry_of(factories):
    """The paper's weights are for the beams they were trained for."""
    full = SCANNERS["tim571"].with_beams(622)
    trained = Geometry(full.angles(), np.array(full.mount), full.range_max)
    return lambda name: trained if name == "paper" else GEOMETRY


def seen_by(name, pose, seed, count):
    if name != "paper":
        return observations(pose, seed, count)
    full = SCANNERS["tim571"].with_beams(622)
    clean = WORLD.ray_distances(se2.compose(pose, full.mount)[None], full.angles())[0]
    rng = np.random.default_rng(seed)
    return [
        Observation(clean + 0.02 * rng.standard_normal(622), full.angles(), full.range_max, k / 15)
        for k in range(count)
    ]


def finish(fleet):
    """What comes of all that was begun, by robot, in the order it came."""
    outcomes = []
    while not fleet.idle:
        outcomes += fleet.step()
    return outcomes


def served(fleet, estimators, scans):
    """Each robot's posteriors; the k-th scans of all wait together."""
    found = {robot: [] for robot in estimators}
    for k in range(max(map(len, scans.values()))):
        for robot, estimator in estimators.items():
            fleet.begin(robot, estimator, scans[robot][k])
        for outcome in finish(fleet):
            assert outcome.error is None
            found[outcome.robot].append(outcome.posterior)
    return found


def assert_same(a, b):
    assert a.state == b.state
    assert np.abs(a.pose - b.pose).max() <= 1e-9
    assert a.free_energy == pytest.approx(b.free_energy, rel=1e-9)
    np.testing.assert_allclose(a.predicted, b.predicted, rtol=1e-9, atol=1e-9)
    if b.covariance is not None:
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", ["precise", "paper", "particle-filter"])
def test_a_robots_beliefs_do_not_depend_on_who_else_is_served(name, factories, geometry_of):
    def fresh():
        return factories[name](geometry_of(name))

    robots = list(STARTS)[: 2 if name == "particle-filter" else 6]
    count = 2 if name == "particle-filter" else 5
    scans = {robot: seen_by(name, STARTS[robot], k, count) for k, robot in enumerate(robots)}
    together = served(Fleet(), {robot: fresh() for robot in robots}, scans)
    for robot in robots:
        estimator = fresh()
        alone = [estimator.update(scan) for scan in scans[robot]]
        assert len(together[robot]) == count
        for a, b in zip(together[robot], alone, strict=True):
            assert_same(a, b)


def test_neither_size_of_the_pieces_nor_of_the_calls_changes_a_number(factories):
    scans = {robot: observations(pose, 5, 3) for robot, pose in STARTS.items()}
    results = [
        served(fleet, {robot: factories["precise"](GEOMETRY) for robot in STARTS}, scans)
        for fleet in (Fleet(), Fleet(piece=10**9, together=100), Fleet(piece=100, together=1))
    ]
    for other in results[1:]:
        for robot in STARTS:
            for a, b in zip(results[0][robot], other[robot], strict=True):
                assert_same(a, b)


@pytest.mark.parametrize("name", ["precise", "paper"])
def test_scans_that_wait_together_are_answered_in_few_calls(name, factories, geometry_of):
    def fresh(robot):
        made = factories[name](geometry_of(name))
        made.restart(STARTS[robot])
        return made

    fleet, single = Fleet(together=6), Fleet(together=1)
    for each in (fleet, single):
        estimators = {robot: fresh(robot) for robot in STARTS}
        scans = {robot: seen_by(name, pose, 1, 2) for robot, pose in STARTS.items()}
        served(each, estimators, {robot: rows[:1] for robot, rows in scans.items()})  # a search of precise
        each.calls = each.answered = 0
        served(each, estimators, {robot: rows[1:] for robot, rows in scans.items()})
    assert single.calls == single.answered == fleet.answered
    assert fleet.calls <= fleet.answered / 3


def tracking(factories, robots):
    made = {robot: factories["precise"](GEOMETRY) for robot in robots}
    for robot, estimator in made.items():
        for scan in observations(STARTS[robot], 2, 3):
            assert estimator.update(scan).state == "tracking"
    return made


def test_those_that_track_are_answered_before_a_search_goes_on(factories):
    made = tracking(factories, ["r0", "r1"])
    fleet = Fleet(piece=10**9)  # so that a search, once it goes on, ends in one step
    fleet.begin("new", factories["precise"](GEOMETRY), observations(STARTS["r3"], 0, 1)[0])
    for robot, estimator in made.items():
        fleet.begin(robot, estimator, observations(STARTS[robot], 4, 4)[3])
    assert [outcome.robot for outcome in finish(fleet)] == ["r0", "r1", "new"]


def test_a_search_in_pieces_is_overtaken_by_whoever_tracks(factories):
    made = tracking(factories, ["r0"])["r0"]
    fleet, done = Fleet(piece=10 * BEAMS), []
    fleet.begin("new", factories["precise"](GEOMETRY), observations(STARTS["r3"], 0, 1)[0])
    fleet.step()
    for scan in observations(STARTS["r0"], 4, 13)[3:]:
        assert fleet.searching
        fleet.begin("r0", made, scan)
        while fleet.busy("r0"):
            done += [outcome.robot for outcome in fleet.step()]
        fleet.step()
    assert done == ["r0"] * 10
    assert [outcome.robot for outcome in finish(fleet)] == ["new"]


class Endless:
    """Tracks for ever: a question after every answer."""

    name = "endless"

    def updating(self, observation):
        while True:
            yield Counted(1000)


class Counted:
    """A question that notes who was asked."""

    def __init__(self, beams, error=None):
        self.beams, self.error, self.alike = beams, error, 0

    def answer(self):
        if self.error:
            raise self.error
        return self.beams

    def answer_all(self, questions):
        return [question.answer() for question in questions]

    def in_pieces(self, beams):
        for _ in range(0, self.beams, beams):
            yield
        return self.answer()


class Says:
    """Asks what it is told to ask."""

    name = "says"

    def __init__(self, *questions):
        self.questions, self.answers = questions, []

    def updating(self, observation):
        for question in self.questions:
            self.answers.append((yield question))
        return self.answers


def test_a_search_has_a_quarter_though_tracking_never_ends():
    from services.estimator.shared.asking import Search  # noqa: PLC0415 - of this test alone

    fleet = Fleet(piece=1000)
    fleet.begin("busy", Endless(), None)
    fleet.begin("new", Says(Search(), Counted(20_000)), None)
    steps = 1
    while not fleet.step():
        steps += 1
    assert steps == pytest.approx(21 * (SHARE + 1), abs=SHARE + 1)


def test_of_two_searches_the_first_ends_first():
    from services.estimator.shared.asking import Search  # noqa: PLC0415

    fleet = Fleet(piece=10)
    fleet.begin("long", Says(Search(), Counted(1000)), None)
    fleet.begin("short", Says(Search(), Counted(100)), None)
    assert [outcome.robot for outcome in finish(fleet)] == ["long", "short"]


def test_an_error_is_the_robots_own():
    fleet, error = Fleet(), RuntimeError("broken")
    good, bad = Says(Counted(1), Counted(2)), Says(Counted(1), Counted(2, error))
    fleet.begin("good", good, None)
    fleet.begin("bad", bad, None)
    outcomes = {outcome.robot: outcome for outcome in finish(fleet)}
    assert outcomes["bad"].error is error
    assert outcomes["good"].error is None
    assert outcomes["good"].posterior == [1, 2]


def test_one_scan_at_a_time(factories):
    fleet, made = Fleet(), factories["precise"](GEOMETRY)
    scan = observations(STARTS["r0"], 0, 1)[0]
    fleet.begin("r0", made, scan)
    with pytest.raises(ValueError, match="r0"):
        fleet.begin("r0", made, replace(scan, stamp=1.0))
    fleet.drop("r0")
    assert fleet.idle
    assert finish(fleet) == []


def test_models_are_shared_between_robots(factories, geometry_of):
    a, b = (factories["precise"](GEOMETRY) for _ in range(2))
    assert a.model is b.model
    assert a.seeds is b.seeds
    a, b = (factories["paper"](geometry_of("paper")) for _ in range(2))
    assert a.model is b.model
