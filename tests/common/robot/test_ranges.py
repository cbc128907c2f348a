"""Meaning of range values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from common.robot.ranges import is_surface, normalise_driver_ranges, ranges_for_localisation

NUMBERS = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, -0.0, -1.0, np.nan, np.inf, -np.inf, 0.1, 8.3, 1e-30, 65.533])
)
RANGES = arrays(np.float32, st.integers(0, 20), elements=NUMBERS)
LIMITS = st.tuples(st.floats(0, 1, width=32), st.floats(1.5, 100, width=32))


@given(RANGES, LIMITS)
def test_driver_ranges_have_four_meanings(ranges, limits):
    least, most = limits
    scan = normalise_driver_ranges(ranges, least, most)
    assert scan.dtype == ranges.dtype
    for sent, found in zip(ranges.tolist(), scan.tolist(), strict=True):
        if np.isnan(sent) or -np.inf < sent <= 0:
            assert found == 0
        elif sent >= most:
            assert found == np.inf
        elif sent < least:
            assert found == -np.inf
        else:
            assert found == sent
    np.testing.assert_array_equal(normalise_driver_ranges(scan, least, most), scan)  # a scan is one already


@given(RANGES, LIMITS)
def test_surfaces_and_ranges_for_localisation(ranges, limits):
    scan = normalise_driver_ranges(ranges, *limits)
    hit, place = is_surface(scan), ranges_for_localisation(scan)
    assert ((scan[hit] >= limits[0]) & (scan[hit] < limits[1])).all()
    assert not np.isfinite(place[~hit]).any()
    np.testing.assert_array_equal(place[hit], scan[hit])
    np.testing.assert_array_equal(place == np.inf, scan == np.inf)  # no return is used for localisation


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_maximum_range_in_both_precisions(dtype):
    for most in (0.7, 8.1, 8.3, 25.0):
        row = np.array([np.float32(most), most, most * 0.999], dtype)
        assert np.isposinf(normalise_driver_ranges(row, 0.0, most)).tolist() == [True, True, False]
