"""The local map: scan matching, surfaces seen before, and poses in its own frame."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry import se2
from common.geometry.world import World
from lab.accuracy.scenes import Scene
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.local_map import (
    KEY_DISTANCE_M,
    ChangeRate,
    LocalMap,
    LocalMapScan,
    LocalScan,
    MovedFraction,
    _beams_towards,
    count_changes,
)
from services.estimator.precise.motion_model import MotionCandidate
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.estimator.shared.generative_models import RayCaster
from tests.estimator.models import ROOM
from tests.estimator.precise.test_changes import HALL

HERE = np.array([3.0, 1.5, 0.4])
STEP = np.diag([0.2, 0.2, 0.3]) ** 2


def view(scene, pose):
    seen = scene.observe(scene.clean(np.array(pose)[None])[0], 0.0)
    mount = np.array(scene.scanner.mount)
    return ScanLikelihood(RayCaster(HALL), Likelihood(), mount, seen.angles, seen.ranges, seen.range_max)


def match_near(made, pose, scan):
    """The match of a scan, starting at ``pose`` (3,) in map."""
    local = made.to_local(np.asarray(pose))
    return made.match(local[None], scan, MotionCandidate(local, STEP, 1.0))


def local_map(scene, *poses, frame=(0.0, 0.0, 0.0)):
    """A local map whose frame lies at ``frame`` in map, with a key scan at each of the poses in map."""
    made = LocalMap(frame=np.array(frame))
    for pose in poses:
        scan = view(scene, pose)
        nothing, everything = np.zeros(len(scan.ranges), np.bool_), np.ones(len(scan.ranges), np.bool_)
        key = LocalMapScan(made.to_local(np.array(pose)), scan, nothing, everything, True, 0.0, 0.0, 0.0)
        made.add(key, np.array(pose), np.diag([1e-4, 1e-4, 1e-5]))
    return made


@given(
    offset=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.12, 0.12)),
    frame=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3)),
    seed=st.integers(0, 99),
)
@settings(max_examples=30, deadline=None)
def test_match_in_any_frame(offset, frame, seed):
    scene = Scene.of(ROOM, 361, seed)
    there = se2.compose(HERE, offset)
    made = local_map(scene, HERE, frame=frame)
    match = match_near(made, HERE, view(scene, there))
    assert match is not None
    assert not match.degenerate
    assert match.matched_fraction > 0.7
    off = se2.between(there, made.candidate(match, STEP, 0.1).mean)
    assert np.hypot(off[0], off[1]) < 0.02
    assert abs(off[2]) < 0.01


def test_covariance_turns_with_the_frame():
    scene = Scene.of(ROOM, 361, 1)
    scan = view(scene, HERE)
    found = []
    for yaw in (0.0, 1.2):
        made = local_map(scene, HERE, frame=(1.0, 2.0, yaw))
        match = match_near(made, HERE, scan)
        found.append(made.candidate(match, STEP, 0.1).covariance)
    assert found[0] == pytest.approx(found[1], rel=0.1, abs=3e-7)


@pytest.mark.parametrize("there", [(12.5, 3.5, 2.0), (14.0, 1.2, -2.0), (9.0, 1.0, 1.0)])
def test_scan_from_elsewhere(there):
    scene = Scene.of(HALL, 361, 1)
    made = local_map(scene, (3.0, 2.0, 0.0))
    assert match_near(made, HERE, view(scene, there)) is None


def test_featureless_hall():
    bare = World(name="bare", boundary=[(0, 0), (60, 0), (60, 2), (0, 2)])
    scene, here = Scene.of(bare, 361, 1), np.array([30.0, 1.0, 0.0])
    made = local_map(scene, here)
    assert match_near(made, here, view(scene, here)) is None


def test_too_few_points():
    scene = Scene.of(ROOM, 361, 1)
    scan = view(scene, HERE)
    assert match_near(LocalMap(), HERE, scan) is None
    few = replace(scan, ranges=np.where(np.arange(len(scan.ranges)) < 3, scan.ranges, np.inf))
    assert len(few.points) == 3
    assert match_near(local_map(scene, HERE), HERE, few) is None


def changed(scan, beams, factor):
    """The scan with some of its ranges multiplied."""
    ranges = scan.ranges.copy()
    ranges[beams] *= factor
    return ScanLikelihood(scan.model, scan.likelihood, scan.mount, scan.angles, ranges, scan.range_max)


def test_seen_surfaces():
    scene = Scene.of(ROOM, 361, 1)
    scan = view(scene, HERE)
    mapped = np.ones(len(scan.ranges), np.bool_)
    seen, appeared = LocalMap().find_seen_and_appeared(HERE, scan, mapped)
    assert not seen.any()
    assert not appeared.any()
    made = local_map(scene, HERE)
    here = made.to_local(HERE)
    assert made.is_key_scan_due(made.to_local(HERE + np.array([1.01 * KEY_DISTANCE_M, 0.0, 0.0])))
    assert not made.is_key_scan_due(here)
    assert made.find_seen_and_appeared(here, view(scene, HERE), mapped)[0].all()
    seen, appeared = made.find_seen_and_appeared(here, changed(scan, slice(100, 150), 0.5), mapped)  # a person
    assert np.flatnonzero(~seen).tolist() == np.flatnonzero(appeared).tolist() == list(range(100, 150))
    seen, appeared = made.find_seen_and_appeared(here, changed(scan, slice(100, 150), 1.5), mapped)  # a door was opened
    assert np.flatnonzero(~seen).tolist() == list(range(100, 150))
    assert not appeared.any()
    behind = replace(scan, ranges=scan.ranges + 0.14)  # another room, whose walls are near those of this one
    seen, _ = made.find_seen_and_appeared(here, behind, mapped)
    assert seen.mean() < 0.5  # only beams that meet walls at a shallow angle


def test_a_wall_of_which_a_part_was_seen():
    """Seeing more of it is no evidence for its place again: its first beam does not count as new."""
    scene = Scene.of(ROOM, 361, 1)
    scan, made = view(scene, HERE), LocalMap()
    nothing = np.zeros(len(scan.ranges), np.bool_)
    first, end = max(
        pairwise(np.flatnonzero(np.append(scan.surfaces.starts, True))), key=lambda each: each[1] - each[0]
    )
    ranges = np.full(len(scan.ranges), -np.inf)
    ranges[first + 40 : end] = scan.ranges[first + 40 : end]
    key = LocalMapScan(np.zeros(3), replace(scan, ranges=ranges), nothing, ~nothing, True, 0.0, 0.0, 0.0)
    made.add(key, HERE, np.diag([1e-4, 1e-4, 1e-5]))
    seen, _ = made.find_seen_and_appeared(np.zeros(3), scan, ~nothing)
    assert seen[first]
    assert not seen[first + 1 : first + 10].any()
    assert seen[first + 40 : end].all()


@pytest.mark.parametrize("tracked", [True, False])
def test_surface_in_place_of_another(tracked):
    """What ends where the map's surface was seen, but not at that surface, was not seen before."""
    scene = Scene.of(ROOM, 361, 1)
    scan, made = view(scene, HERE), local_map(scene)
    nothing = np.zeros(len(scan.ranges), np.bool_)
    mapped = ~nothing
    mapped[100:150] = False
    covariance = np.diag([1e-4, 1e-4, 1e-5])
    made.add(LocalMapScan(np.zeros(3), scan, nothing, ~nothing, tracked, 0.0, 0.0, 0.0), HERE, covariance)
    seen, appeared = made.find_seen_and_appeared(np.zeros(3), scan, mapped)
    assert np.flatnonzero(~seen).tolist() == (list(range(100, 150)) if tracked else [])
    assert not appeared.any()
    made.add(LocalMapScan(np.zeros(3), scan, nothing, mapped, tracked, 0.0, 0.0, 0.0), HERE, covariance)
    assert made.find_seen_and_appeared(np.zeros(3), view(scene, HERE), mapped)[0].all()


def test_changes_between_scans():
    scene = Scene.of(ROOM, 361, 1)
    first, now = view(scene, HERE), view(scene, HERE)

    def changes(pose, scan):
        return count_changes(LocalScan(HERE, first), LocalScan(pose, scan))

    assert changes(HERE, now) == 0
    by_20_cm = 0.2 / now.ranges[100:180]
    for factor in (0.5, 2.0, 1 - by_20_cm, 1 + by_20_cm):  # something appears, vanishes, is replaced by its like
        one = changes(HERE, changed(now, slice(100, 180), factor))
        assert one > 0
        assert changes(HERE, changed(changed(now, slice(100, 180), factor), slice(250, 330), factor)) > one
    assert changes(HERE, changed(now, slice(100, 102), 0.5)) == 0  # too few beams for a surface
    assert changes(HERE, changed(now, slice(100, 102), 2.0)) == 0
    step = se2.compose(HERE, [0.05, 0.0, 0.1])
    assert changes(step, view(scene, step)) == 0


def test_change_rate():
    """The numbers of changes have a distribution, which follows their rate and forgets it."""
    rate, period = ChangeRate(), 0.2
    assert sum(math.exp(rate.log_probability(n, period)) for n in range(100)) == pytest.approx(1)
    quiet = rate.log_probability(5, period)
    for _ in range(500):
        rate.learn(5, period)
    assert sum(n * math.exp(rate.log_probability(n, period)) for n in range(100)) == pytest.approx(5, rel=0.1)
    busy = rate.log_probability(5, period)
    for _ in range(3000):
        rate.learn(0, period)
    assert rate.log_probability(5, period) == pytest.approx(quiet, abs=5)
    assert busy > quiet + 15


def test_moved_fraction():
    """It is learned from the surfaces of each scan, and forgotten."""
    fraction = MovedFraction()
    before = fraction.probability
    for _ in range(500):
        fraction.learn(6, 2, 0.1)
    assert fraction.probability == pytest.approx(0.75, abs=0.02)
    after_a_gap = MovedFraction()
    after_a_gap.learn(1, 0, 10.0)
    assert after_a_gap.probability < 0.4
    for _ in range(3000):
        fraction.learn(0, 0, 0.07)
    assert fraction.probability == pytest.approx(before, abs=0.02)


def test_beams_of_a_corrected_scan():
    """Each point belongs to its own beam, although the beams are not evenly spaced."""
    angles = np.linspace(-2, 2, 50) + 0.03 * np.sin(np.linspace(0, 6, 50))
    uneven = ScanLikelihood(RayCaster(HALL), Likelihood(), np.zeros(3), angles, np.full(50, 2.0), 25.0)
    _, beam, inside = _beams_towards(uneven, HERE, se2.transform(HERE, uneven.points))
    assert inside.sum() == 48
    assert (beam[inside] == np.arange(1, 49)).all()
