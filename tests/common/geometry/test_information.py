from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry.information import subtract_spurious


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1.0), st.integers(0, 8))
def test_information_that_is_not_spurious(seed, unit_of_yaw, count):
    """It is between 0 and all of the information, in whatever unit the heading is."""
    rng, unit = np.random.default_rng(seed), np.array([1, 1, unit_of_yaw])
    information, spurious = ((J.T @ J) @ np.eye(3) for J in (rng.normal(size=(count, 3)), rng.normal(size=(5, 3))))
    left = subtract_spurious(information, spurious)
    assert np.linalg.eigvalsh(left).min() >= -1e-6
    assert np.linalg.eigvalsh(information - left).min() >= -1e-6
    assert subtract_spurious(information, 0 * spurious) == pytest.approx(information, abs=1e-6)
    units = np.outer(unit, unit)
    assert subtract_spurious(units * information, units * spurious) / units == pytest.approx(left, abs=1e-6)


def test_information_in_one_direction_only():
    information = np.diag([4.0, 0.0, 1.0])
    assert subtract_spurious(information, np.diag([1.0, 1.0, 2.0])) == pytest.approx(np.diag([3.0, 0.0, 0.0]), abs=1e-5)
