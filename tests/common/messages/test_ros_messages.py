"""Stamps, transforms and mounts from ROS messages."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry import se2
from common.messages.ros_messages import IDENTITY, Transform, mount_of, read_pose, read_rotation, stamp_of

ANGLES = st.floats(-3.1, 3.1)
METRES = st.floats(-50, 50)


def vector(**values):
    return SimpleNamespace(**values)


def quaternion(yaw=0.0, roll=0.0):
    a, b = yaw / 2, roll / 2
    parts = (np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.sin(a) * np.cos(b), np.cos(a) * np.cos(b))
    return vector(**dict(zip("xyzw", parts, strict=True)))


def placed(x, y, yaw, roll=0.0) -> Transform:
    return read_pose(vector(x=x, y=y, z=0.3), quaternion(yaw, roll))


@given(METRES, METRES, ANGLES, ANGLES)
def test_transforms_have_inverses(x, y, yaw, roll):
    one = placed(x, y, yaw, roll)
    assert one.then(one.inverse()).difference(IDENTITY) < 1e-9
    assert np.linalg.det(one.rotation) == pytest.approx(1)


@given(METRES, METRES, ANGLES, METRES, METRES, ANGLES)
def test_level_transforms(x, y, yaw, u, v, turn):
    found = placed(x, y, yaw).then(placed(u, v, turn)).planar()
    wanted = se2.compose([x, y, yaw], [u, v, turn])
    np.testing.assert_allclose(found[:2], wanted[:2], atol=1e-9)
    assert abs(se2.wrap(found[2] - wanted[2])) < 1e-9


@given(ANGLES, st.booleans(), st.floats(-0.08, 0.08))
def test_nearly_level_scanners(yaw, hangs, lean):
    mount = mount_of(placed(1.0, 2.0, yaw, lean + (np.pi if hangs else 0.0)))
    assert mount.upside_down == hangs
    np.testing.assert_allclose(mount.pose, [1, 2, yaw], atol=1e-9)


@pytest.mark.parametrize("lean_deg", [6.0, 90.0, 174.0])
def test_tilted_scanners_are_refused(lean_deg):
    with pytest.raises(ValueError, match=r"inclined by \d+ degrees"):
        mount_of(placed(0, 0, 0, np.deg2rad(lean_deg)))


@pytest.mark.parametrize("wrong", [dict.fromkeys("xyzw", 0.0), {**dict.fromkeys("xyz", 0.0), "w": np.nan}])
def test_invalid_rotations_are_refused(wrong):
    with pytest.raises(ValueError, match="not a rotation"):
        read_rotation(vector(**wrong))
    with pytest.raises(ValueError, match="m is not finite"):
        read_pose(vector(x=np.inf, y=0.0, z=0.0), quaternion())


def test_stamps_are_exact():
    assert stamp_of(vector(stamp=vector(sec=1_600_000_000, nanosec=1))) == 1_600_000_000_000_000_001
