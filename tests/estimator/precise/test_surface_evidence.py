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
from services.estimator.precise.scan_surfaces import ScanSurfaces
from services.estimator.precise.surface_evidence import CHANGED, SurfaceEvidence
from services.estimator.shared.generative_models import Expected

RANGE_MAX = 25.0
SIGMA_M = 0.01
ANGLES = np.deg2rad(np.linspace(-60, 60, 241))
SQUARE = [(0, 0), (6, 0), (6, 6), (0, 6)]
WALL = np.array([[3.0, 3.0, 0.0]])  # sees one wall and the ends of two more
CORNER = np.array([[3.0, 3.0, np.pi / 4]])
COLUMN = [{"box": {"center": (4.5, 3.0), "size": (0.6, 0.6)}}]
BEAMS = 5
SHARE = 0.25  # of surfaces that the map does not show as they are
PRIOR = np.array([1 - SHARE, *SHARE * CHANGED[1:]])


def surfaces_of(ranges, sigma=SIGMA_M):
    return ScanSurfaces.of(ranges, ANGLES, Likelihood(sigma))


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
    assert found.density[120] == found.ideal[120]


def test_surfaces_without_return():
    ranges = scan(WALL)
    ranges[80:120] = np.inf
    ranges[130] = np.nan
    found = surfaces_of(ranges)
    assert np.flatnonzero(found.starts[70:140]).tolist() == [10, 50]
    assert found.density[130] == found.ideal[130] == 0


@pytest.mark.parametrize("sigma", [0.003, 0.03])
def test_a_wall_predicts_itself(sigma):
    """Only its beginning surprises; the rest of a straight wall is as likely as if it had been known."""
    found = surfaces_of(scan(WALL, sigma=sigma)[40:200], sigma)
    surprise = found.ideal - found.density
    assert found.starts.sum() == 1
    assert surprise[0] > 1
    assert np.abs(surprise[10:]).mean() < 0.1


def by_enumeration(emitted, starts, change, skip):
    """Log-likelihood of the beams that are not skipped, and the weight (B,) of the first state."""
    keep = np.where(starts, 0.0, 1 - change)
    keep[0] = 0.0
    total, weight, before = 0.0, np.zeros(len(emitted)), 1.0
    for count in range(1, len(emitted) + 1):
        evidence, weight = 0.0, np.zeros(len(emitted))
        for states in product(range(len(PRIOR)), repeat=count):
            p = PRIOR[states[0]] * emitted[0, states[0]]
            for b, (old, new) in enumerate(pairwise(states), 1):
                p *= (keep[b] * (old == new) + (1 - keep[b]) * PRIOR[new]) * emitted[b, new]
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
    density, starts, change = rng.normal(0, 1, BEAMS), rng.random(BEAMS) < 0.3, rng.uniform(0.01, 0.3)
    skip = rng.random(BEAMS) < 0.3
    starts[0] = True
    # Next to where a surface begins, the beam expected nearest to the range counts.
    edge = starts | np.append(starts[1:], False)
    emitted = np.empty((BEAMS, len(PRIOR)))
    for b in range(BEAMS):
        near = [k for k in range(max(0, b - 2), min(BEAMS, b + 3)) if edge[b] or k == b]
        at = min(near, key=lambda k, b=b: abs(ranges[b] - surface[k]))
        surface_evidence._emit(
            ranges[b], surface[at], behind[at], scale[at], 0.05, 0.0, RANGE_MAX, density[b], 1.0 - starts[b], emitted[b]
        )
    total, weights = by_enumeration(np.exp(emitted), starts, change, skip)
    made = ScanSurfaces(density, starts, np.zeros(BEAMS), np.zeros(BEAMS, np.bool_), change)
    expected = Expected(surface[None], scale[None], np.zeros((1, BEAMS, 3)))
    found = SurfaceEvidence.of(ranges, RANGE_MAX, expected, behind[None], made, likelihood, SHARE, skip=skip)
    assert found.log_likelihood[0] == pytest.approx(total, abs=1e-9)
    assert found.weights[0] == pytest.approx(weights, abs=1e-9)


def test_unused_beams():
    """A beam that measured nothing is no evidence, and has no weight."""
    ranges, rng = scan(WALL), np.random.default_rng(1)
    ranges[rng.choice(len(ranges), 20, replace=False)] = np.nan
    used = ~np.isnan(ranges)
    world = World(name="square", boundary=SQUARE)
    found = []
    for chosen in (np.ones(len(ranges), np.bool_), used):
        angles, likelihood = ANGLES[chosen], Likelihood(SIGMA_M)
        surfaces = ScanSurfaces.of(ranges[chosen], angles, likelihood)
        count = int(chosen.sum())
        mapped = world.ray_distances(WALL, angles)
        expected = Expected(mapped, np.full((1, count), 1e-3), np.zeros((1, count, 3)))
        behind = np.full((1, count), np.inf)
        found.append(SurfaceEvidence.of(ranges[chosen], RANGE_MAX, expected, behind, surfaces, likelihood, SHARE))
    assert found[0].log_likelihood == pytest.approx(found[1].log_likelihood, abs=1)
    assert found[0].weights[0, used] == pytest.approx(found[1].weights[0], abs=0.05)
    assert not found[0].weights[0, ~used].any()


def test_one_event_however_many_beams():
    """A column that the map lacks, or that was removed, costs about the same with three times as many beams."""
    bare = World(name="bare", boundary=SQUARE)
    column = World(name="column", boundary=SQUARE, obstacles=COLUMN)
    likelihood = Likelihood(SIGMA_M)
    for real, mapped in ((column, bare), (bare, column)):
        losses = []
        for count in (121, 361):
            angles = np.deg2rad(np.linspace(-60, 60, count))
            noise = SIGMA_M * np.random.default_rng(1).standard_normal(count)
            ranges = real.ray_distances(WALL, angles)[0] + noise
            evidence = []
            for world in (real, mapped):
                expected = Expected(
                    world.ray_distances(WALL, angles), np.full((1, count), 1e-3), np.zeros((1, count, 3))
                )
                behind = bare.ray_distances(WALL, angles) if world is column else np.full((1, count), np.inf)
                surfaces = ScanSurfaces.of(ranges, angles, likelihood)
                evidence.append(SurfaceEvidence.of(ranges, RANGE_MAX, expected, behind, surfaces, likelihood, SHARE))
            losses.append(float(evidence[0].log_likelihood[0] - evidence[1].log_likelihood[0]))
            assert evidence[0].explained[0] > 0.98
        assert 1 < losses[1] < 25
        assert abs(losses[1] - losses[0]) < 5
