"""Poses: group laws, wrapping, and Jacobians compared with finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry import se2

poses = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1)).map(np.array)


def assert_same_pose(a, b, tolerance=1e-8):
    assert np.hypot(*(a - b)[:2]) < tolerance
    assert abs(float(se2.wrap(a[2] - b[2]))) < tolerance


@given(st.floats(-1e6, 1e6) | st.sampled_from([np.pi, -np.pi, 3 * np.pi, -1e-17]))
def test_wrap(angle):
    wrapped = float(se2.wrap(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-6)


@given(poses, poses, poses)
def test_group_laws(a, b, c):
    assert_same_pose(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))
    assert_same_pose(se2.compose(a, se2.inverse(a)), np.zeros(3))
    assert_same_pose(se2.compose(a, se2.between(a, b)), b)


def test_known_poses():
    assert_same_pose(se2.compose([1, 2, np.pi / 2], [3, 0, 0.5]), np.array([1, 5, np.pi / 2 + 0.5]))
    assert se2.compose(np.arange(12.0).reshape(4, 3), [0.2, 0, 0]).shape == (4, 3)
    assert se2.rotate(np.pi / 2, [[1, 0], [0, 1]]) == pytest.approx(np.array([[0, 1], [-1, 0]]))


@given(poses, poses)
def test_jacobians(a, b):
    h = 1e-6
    for found, which in zip(se2.compose_jacobians(a, b), (0, 1), strict=True):
        for axis in range(3):
            plus, minus = [a, b], [a, b]
            plus[which] = plus[which] + h * np.eye(3)[axis]
            minus[which] = minus[which] - h * np.eye(3)[axis]
            difference = se2.compose(*plus) - se2.compose(*minus)
            difference[2] = se2.wrap(difference[2])
            assert found[:, axis] == pytest.approx(difference / (2 * h), abs=1e-4)


@given(poses, poses, st.floats(-np.pi, np.pi))
def test_displacement_jacobian_is_the_finite_difference(pose, point, heading):
    direction, h = np.array([[np.cos(heading), np.sin(heading)]]), 1e-6
    offset = se2.transform(pose, point[None, :2]) - pose[:2]
    steps = [
        (se2.transform(pose + axis, point[None, :2]) - se2.transform(pose - axis, point[None, :2])) @ direction[0]
        for axis in h * np.eye(3)
    ]
    expected = np.concatenate(steps) / (2 * h)
    assert se2.displacement_jacobian(offset, direction)[0] == pytest.approx(expected, abs=1e-4)


@given(poses, poses)
def test_points_transform_like_poses(a, b):
    assert se2.transform(a, b[None, :2])[0] == pytest.approx(se2.compose(a, b)[:2], abs=1e-9)


def test_alignment():
    targets = np.random.default_rng(0).uniform(-2, 2, (20, 3))
    frame = np.array([3.0, -1.0, 0.5])
    assert se2.alignment(se2.compose(se2.inverse(frame), targets), targets) == pytest.approx(frame)
