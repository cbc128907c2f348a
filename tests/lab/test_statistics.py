"""Intervals of shares and errors."""

from __future__ import annotations

import numpy as np
import pytest

from lab.statistics import bootstrap_interval, longest_duration, median, root_mean_square, wilson_interval


def test_shares():
    assert wilson_interval(294, 300) == pytest.approx([0.9570, 0.9908], abs=1e-3)
    assert wilson_interval(0, 100) == pytest.approx([0.0, 0.0370], abs=1e-3)
    assert wilson_interval(100, 100) == pytest.approx([0.9630, 1.0], abs=1e-3)


def test_errors():
    values = np.random.default_rng(1).standard_normal(400)
    alone = bootstrap_interval(list(values[:, None]), root_mean_square)
    rms = root_mean_square(values)
    assert alone == pytest.approx([0.93 * rms, 1.07 * rms], abs=0.02)
    # Groups of equal values have fewer independent ones, so the interval is wider.
    alike = bootstrap_interval([np.full(20, value) for value in values[:20]], root_mean_square)
    assert np.ptp(alike) > 2 * np.ptp(alone)
    assert bootstrap_interval([values], root_mean_square) is None


def test_interval_of_a_median():
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(100):
        low, high = bootstrap_interval(list(rng.exponential(size=(41, 1))), median)
        covered += low <= np.log(2) <= high
    assert 88 <= covered <= 99


@pytest.mark.parametrize(
    ("values", "longest"), [([], 0), ([0, 0], 0), ([1], 1), ([1, 1, 0, 1, 1, 1], 3), ([1, 1, 0, 1], 2)]
)
def test_durations(values, longest):
    values = np.array(values, bool)
    assert longest_duration(values, np.full(len(values), 1 / 15)) == pytest.approx(longest / 15, abs=1e-6)


def test_durations_of_uneven_and_of_many_periods():
    assert longest_duration(np.ones(15, bool), np.full(15, 1 / 15)) == 1.0
    assert longest_duration(np.array([True, True, False, True]), np.array([1.0, 1.0, 5.0, 3.0])) == 3.0
