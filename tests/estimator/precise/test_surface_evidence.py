"""Surfaces of a scan, and the evidence of their beams for a pose, compared with sums over all sequences of states."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry.world import World
from services.estimator.precise import surface_evidence
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.estimator.precise.scan_surfaces import ScanSurfaces
from services.estimator.precise.surface_evidence import CHANGED_STATE_PRIOR, SurfaceEvidence, find_borders
from services.estimator.shared.generative_models import Expected, RayCaster

RANGE_MAX = 25.0
SIGMA_M = 0.01
ANGLES = np.deg2rad(np.linspace(-60, 60, 241))
SQUARE = [(0, 0), (6, 0), (6, 6), (0, 6)]
WALL = np.array([[3.0, 3.0, 0.0]])  # sees one wall and the ends of two more
CORNER = np.array([[3.0, 3.0, np.pi / 4]])
COLUMN = [{"box": {"center": (4.5, 3.0), "size": (0.6, 0.6)}}]
BEAMS = 5
CHANGED_FRACTION = 0.25  # of the beams
PRIOR = np.array([1 - CHANGED_FRACTION, *CHANGED_FRACTION * CHANGED_STATE_PRIOR[1:]])


def surfaces_of(ranges, sigma=SIGMA_M):
    return ScanSurfaces.from_scan(ranges, ANGLES, Likelihood(sigma))


def scan(laser, obstacles=(), sigma=SIGMA_M, seed=0):
    world = World(name="square", boundary=SQUARE, obstacles=list(obstacles))
    return world.ray_distances(laser, ANGLES)[0] + sigma * np.random.default_rng(seed).standard_normal(len(ANGLES))


@pytest.mark.parametrize(
    ("laser", "obstacles", "starts"),
    [(WALL, (), 3), (CORNER, (), 2), (WALL, COLUMN, 5)],
    ids=["three walls", "corner", "column"],
)
def test_number_of_surfaces(laser, obstacles, starts):
    assert surfaces_of(scan(laser, obstacles)).starts.sum() == starts


def test_lone_beam():
    ranges = scan(WALL)
    ranges[120] = 1.0
    found = surfaces_of(ranges)
    assert found.starts.sum() == 3
    assert found.log_density[120] == found.known_log_density[120]


def test_surfaces_without_return():
    ranges = scan(WALL)
    ranges[80:120] = np.inf
    ranges[130] = np.nan
    found = surfaces_of(ranges)
    assert np.flatnonzero(found.starts[70:140]).tolist() == [10, 50]
    assert found.log_density[130] == found.known_log_density[130] == 0


@pytest.mark.parametrize("sigma", [0.003, 0.03])
def test_a_wall_predicts_itself(sigma):
    """Only its beginning surprises; the rest of a straight wall is as likely as if it had been known."""
    found = surfaces_of(scan(WALL, sigma=sigma)[40:200], sigma)
    surprise = found.known_log_density - found.log_density
    assert found.starts.sum() == 1
    assert surprise[0] > 1
    assert np.abs(surprise[10:]).mean() < 0.1


def evidence_in(world, ranges, angles, sigma=SIGMA_M, bare=None):
    """The evidence of a scan at `WALL` for a ``world``; what was removed there is not in the world ``bare``."""
    expected = RayCaster(world).expect(WALL, angles)
    behind = bare.ray_distances(WALL, angles) if bare else np.full((1, len(angles)), np.inf)
    borders = find_borders(expected, WALL, angles)
    surfaces = ScanSurfaces.from_scan(ranges, angles, Likelihood(sigma))
    return SurfaceEvidence.from_scan(
        ranges, RANGE_MAX, expected, behind, borders, surfaces, Likelihood(sigma), CHANGED_FRACTION
    )


@pytest.mark.parametrize(
    ("laser", "obstacles", "count"),
    [
        (WALL, [], 0),
        (CORNER, [], 0),
        (WALL, COLUMN, 2),
        (WALL, [{"circle": {"center": (4.5, 3.0), "radius": 0.3}}], 2),
    ],
    ids=["three walls", "corner", "column", "round column"],
)
def test_borders_of_the_map(laser, obstacles, count):
    """The map shows another surface where a column covers the wall, but not in a corner or around the column."""
    world = World(name="square", boundary=SQUARE, obstacles=obstacles)
    borders = find_borders(RayCaster(world).expect(laser, ANGLES), laser, ANGLES)[0]
    assert borders[0]
    assert borders[1:].sum() == count


def by_enumeration(emitted, starts, borders, change, skip):
    """Log-likelihood of the beams that are not skipped, and the weight (B,) of the first state."""
    keep = np.tile(np.where(starts, 0.0, 1 - change)[:, None], len(PRIOR))
    keep[np.ix_(borders, [0, 2, 3])] = 0.0
    total, weight, before = 0.0, np.zeros(len(emitted)), 1.0
    for count in range(1, len(emitted) + 1):
        evidence, weight = 0.0, np.zeros(len(emitted))
        for states in product(range(len(PRIOR)), repeat=count):
            p = PRIOR[states[0]] * emitted[0, states[0]]
            for b, (old, new) in enumerate(pairwise(states), 1):
                p *= (keep[b, old] * (old == new) + (1 - keep[b, old]) * PRIOR[new]) * emitted[b, new]
            evidence += p
            weight[:count] += p * (np.array(states) == 0)
        total += 0.0 if skip[count - 1] else np.log(evidence / before)
        weight, before = weight / evidence, evidence
    return total, weight


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_forward_and_backward_algorithm(seed):
    rng, likelihood = np.random.default_rng(seed), Likelihood(0.05)
    surface = rng.uniform(2, 4, BEAMS)
    behind, scale = surface + rng.uniform(0.5, 2, BEAMS), rng.uniform(0, 0.1, BEAMS)
    chosen = rng.integers(0, 5, BEAMS)
    ranges = np.choose(chosen, [surface, behind, rng.uniform(0.5, 2, BEAMS), surface + 0.3, np.full(BEAMS, np.inf)])
    ranges = ranges + 0.05 * rng.standard_normal(BEAMS)
    (density, ideal), starts = rng.normal(0, 1, (2, BEAMS)), rng.random(BEAMS) < 0.3
    borders = rng.random(BEAMS) < 0.3
    change = rng.uniform(0.01, 0.3)
    skip = rng.random(BEAMS) < 0.3
    starts[0] = True
    edges = rng.integers(0, 2, BEAMS)
    emitted = np.empty((BEAMS, len(PRIOR)))
    for b in range(BEAMS):
        at, expected_range = surface_evidence._nearest_surface(ranges[b], surface, b, edges[b])
        surface_evidence._emit(
            ranges[b],
            expected_range,
            behind[at],
            scale[at],
            0.05,
            0.0,
            RANGE_MAX,
            density[b],
            ideal[b],
            starts[b],
            emitted[b],
        )
    total, weights = by_enumeration(np.exp(emitted), starts, borders, change, skip)
    made = ScanSurfaces(density, starts, ideal, np.zeros(BEAMS, np.bool_), edges, change)
    expected = Expected(surface[None], scale[None], np.zeros((1, BEAMS, 3)))
    found = SurfaceEvidence.from_scan(
        ranges, RANGE_MAX, expected, behind[None], borders[None], made, likelihood, CHANGED_FRACTION
    )
    assert found.without(skip)[0] == pytest.approx(total, abs=1e-9)
    assert found.log_likelihood[0] == pytest.approx(found.without(np.zeros(BEAMS, np.bool_))[0])
    assert found.weights[0] == pytest.approx(weights, abs=1e-9)


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_misplaced_edges(reach):
    """An edge of a slanting wall may be ``reach`` beams nearer to the end of the wall than in the map."""
    near = 1 / (0.3 + 0.5 * ANGLES)[100:141]  # a straight wall at small angles
    expected = np.concatenate([np.full(20, 9.0), near[20:]])
    beams = np.arange(18, 22)
    found = [surface_evidence._nearest_surface(near[b], expected, b, reach)[1] for b in beams]
    assert np.isclose(found, near[beams], rtol=1e-3).tolist() == (20 - beams <= reach).tolist()


@pytest.mark.parametrize(("edge_error", "reach"), [(0.02, 2), (0.05, 3)])
def test_beams_near_edges(edge_error, reach):
    """An edge at 2 m may be misplaced by this and one beam; each of these 240 beams covers 17 mm there."""
    ranges = np.full(len(ANGLES), 5.0)
    ranges[100:140] = 2.0
    edges = ScanSurfaces.from_scan(ranges, ANGLES, Likelihood(SIGMA_M), edge_error).edge_tolerance
    beams = [beam for first in (100, 140) for beam in range(first - reach, first + reach)]
    assert np.flatnonzero(edges).tolist() == beams
    assert set(edges[edges > 0]) == {reach}


def test_edges_of_a_grid():
    """An obstacle in a grid is up to a cell too wide, so beams pass where the map shows it."""
    column = {"box": {"center": (3.8, 3.0), "size": (0.1, 0.22)}}
    cells = {"box": {"center": (3.8, 3.0), "size": (0.1, 0.3)}}
    in_map = RayCaster(World(name="square", boundary=SQUARE, obstacles=[cells]))
    log_likelihood = [
        ScanLikelihood(in_map, Likelihood(SIGMA_M), np.zeros(3), ANGLES, scan(WALL, [column]), 25.0, map_cell=cell)
        .surface_evidence(WALL[:1])
        .log_likelihood[0]
        for cell in (0.0, 0.05)
    ]
    assert log_likelihood[1] > log_likelihood[0] + 4


def test_corners_of_the_map():
    """At the true pose, a corner that the map shows costs nothing, although the scan alone does not predict it."""
    angles = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    world = World(name="square", boundary=SQUARE)
    ranges = world.ray_distances(WALL, angles)[0] + SIGMA_M * np.random.default_rng(0).standard_normal(400)
    surfaces = ScanSurfaces.from_scan(ranges, angles, Likelihood(SIGMA_M))
    assert surfaces.log_density.sum() < surfaces.known_log_density.sum() - 20
    assert evidence_in(world, ranges, angles).log_likelihood[0] > surfaces.known_log_density.sum() - 10


def test_unused_beams():
    """A beam that measured nothing is no evidence, and has no weight."""
    ranges, rng = scan(WALL), np.random.default_rng(1)
    away_from_edges = np.flatnonzero(surfaces_of(ranges).edge_tolerance == 0)
    ranges[rng.choice(away_from_edges, 20, replace=False)] = np.nan
    used = ~np.isnan(ranges)
    world = World(name="square", boundary=SQUARE, obstacles=COLUMN)
    chosen = (np.ones(len(ranges), np.bool_), used)
    found = [
        evidence_in(world, ranges[each], ANGLES[each], bare=World(name="bare", boundary=SQUARE)) for each in chosen
    ]
    assert found[0].log_likelihood == pytest.approx(found[1].log_likelihood, abs=1)
    assert found[0].weights[0, used] == pytest.approx(found[1].weights[0], abs=0.05)
    assert not found[0].weights[0, ~used].any()


@pytest.mark.parametrize("unmeasured", [-np.inf, np.nan])
def test_lone_beams_among_unmeasured_ones(unmeasured):
    ranges = np.full(400, unmeasured)
    ranges[[100, 103]] = 2.0, 3.0
    assert surfaces_of(ranges).small[[100, 103]].all()


def test_one_event_however_many_beams():
    """A column that the map lacks, or that was removed, costs about the same with three times as many beams."""
    bare = World(name="bare", boundary=SQUARE)
    column = World(name="column", boundary=SQUARE, obstacles=COLUMN)
    for real, mapped in ((column, bare), (bare, column)):
        losses = []
        for count in (121, 361):
            angles = np.deg2rad(np.linspace(-60, 60, count))
            noise = SIGMA_M * np.random.default_rng(1).standard_normal(count)
            ranges = real.ray_distances(WALL, angles)[0] + noise
            at_real, at_mapped = (
                evidence_in(world, ranges, angles, bare=bare if world is column else None) for world in (real, mapped)
            )
            losses.append(float(at_real.log_likelihood[0] - at_mapped.log_likelihood[0]))
            assert at_real.explained[0] > 0.98
        assert 1 < losses[1] < 25
        assert abs(losses[1] - losses[0]) < 5


def test_each_removed_thing_costs_its_probability():
    """A table whose legs are gone costs little more than what the map says of how often such a thing is gone."""
    bare = World(name="bare", boundary=SQUARE)
    legs = [{"circle": {"center": (4.5, y), "radius": 0.04}} for y in (2.0, 2.7, 3.3, 4.0)]
    ranges = scan(WALL)
    without = evidence_in(bare, ranges, ANGLES)
    with_legs = evidence_in(World(name="table", boundary=SQUARE, obstacles=legs), ranges, ANGLES, bare=bare)
    cost = float(without.log_likelihood[0] - with_legs.log_likelihood[0]) / len(legs)
    gone = -np.log(PRIOR[2] + PRIOR[3])
    assert gone - 0.5 < cost < gone - np.log(PRIOR[0]) + 0.5
    assert with_legs.explained[0] > 0.95
