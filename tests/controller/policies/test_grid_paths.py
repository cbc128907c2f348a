"""Compares cheapest paths with those of scipy, and repaired paths with paths that are computed from scratch."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import dijkstra

from services.controller.policies.grid_paths import NO_CELL, cheapest_paths, repaired_paths
from tests.controller.policies.reference_paths import moves


def random_grid(rng) -> np.ndarray:
    shape = tuple(rng.integers(1, 12, 2))
    return np.where(rng.random(shape) < rng.uniform(0.5, 1.0), rng.uniform(0.1, 1.0, shape), np.inf)


def costs_by_following(cell_cost, next_cell) -> np.ndarray:
    """Cost (cells,) from each cell, by adding the costs of the moves on its path."""
    matrix = moves(cell_cost).toarray()
    costs = np.zeros(cell_cost.size)
    for cell in range(cell_cost.size):
        here = cell
        while (following := next_cell[here]) != NO_CELL:
            costs[cell] += matrix[here, following]
            here = following
    return costs


@given(st.integers(0, 2**32 - 1))
def test_cheapest_paths(seed):
    rng = np.random.default_rng(seed)
    cell_cost = random_grid(rng)
    starts = rng.integers(cell_cost.size, size=rng.integers(1, 4))
    start_costs, limit = rng.uniform(0, 3, len(starts)), rng.choice([2.0, np.inf])
    from_starts = dijkstra(moves(cell_cost), indices=starts)
    expected = (from_starts + start_costs[:, None]).min(axis=0)
    cost, next_cell = cheapest_paths(cell_cost, starts, start_costs, limit)
    np.testing.assert_allclose(cost, np.where(expected <= limit, expected, np.inf), rtol=1e-12)
    reached = np.isfinite(cost)
    if len(starts) == 1:
        followed = costs_by_following(cell_cost, next_cell) + start_costs.min()
        np.testing.assert_allclose(followed[reached], cost[reached], rtol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_repaired_paths(seed):
    """Up to the limit, they are the paths around the obstacles; above it, no cost is below the limit."""
    rng = np.random.default_rng(seed)
    cell_cost = random_grid(rng)
    start = int(rng.integers(cell_cost.size))
    known = cheapest_paths(cell_cost, np.array([start]), np.zeros(1))
    increased = np.flatnonzero(rng.random(cell_cost.size) < rng.uniform(0, 0.5))
    after = cell_cost.copy()
    after.ravel()[increased] *= rng.choice([1.5, np.inf], len(increased))
    if not np.isfinite(after.ravel()[start]):  # the paths end elsewhere, as beside an occupied goal
        remaining = np.flatnonzero(np.isfinite(known[0]) & np.isfinite(after.ravel()))
        if start not in increased or not len(remaining):
            return
        start = int(rng.choice(remaining))
    limit = rng.choice([0.5, 2.0, np.inf])
    before = [each.copy() for each in known]
    cost, next_cell = repaired_paths(after, known, increased, start, limit)
    for each, kept in zip(known, before, strict=True):
        np.testing.assert_array_equal(each, kept)
    expected, _ = cheapest_paths(after, np.array([start]), known[0][[start]])
    within = expected <= limit
    np.testing.assert_allclose(cost[within], expected[within], rtol=1e-12)
    assert not (cost[~within] <= limit).any()
    followed = costs_by_following(after, next_cell) + known[0][start]
    reached = within & np.isfinite(cost)
    np.testing.assert_allclose(followed[reached], cost[reached], rtol=1e-12)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_grid_of_one_row_or_column(shape):
    cost, _ = cheapest_paths(np.ones(shape), np.array([0]), np.zeros(1))
    np.testing.assert_allclose(cost, np.arange(np.prod(shape)))
