"""Swept scans, corrected with the true motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry import se2
from common.geometry.world import World
from common.messages.definitions import Pose, Scan
from common.robot.motion_distortion import beam_times, correct_beams, correct_scan

HALL = World(name="hall", boundary=[(0, 0), (8, 0), (8, 6), (0, 6)])
ANGLES = np.linspace(-2.3, 2.3, 300)
INCREMENT = 1e-4  # s
speeds, turns = st.floats(-2, 2), st.floats(-3, 3)


def swept(start, velocity, mount, increment=INCREMENT):
    """Ranges (B,) in the hall, and the poses (B, 3) at which they were measured, relative to ``start``."""
    poses = beam_times(len(ANGLES), increment)[:, None] * velocity
    lasers = se2.compose(se2.compose(start, poses), mount)
    lasers[:, 2] += ANGLES
    return HALL.ray_distances(lasers, np.zeros(1))[:, 0], poses


@given(
    start=st.tuples(st.floats(2, 6), st.floats(2, 4), turns),
    velocity=st.tuples(speeds, speeds, turns),
    mount=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), turns),
    increment=st.sampled_from([INCREMENT, -INCREMENT]),
)
def test_correction_with_the_true_motion(start, velocity, mount, increment):
    """The same points as seen from the pose at the stamp."""
    ranges, poses = swept(np.array(start), np.array(velocity), np.array(mount), increment)
    corrected, angles = correct_beams(ranges, ANGLES, poses, np.array(mount))
    exact = HALL.ray_distances(se2.compose(start, mount)[None], angles)[0]
    np.testing.assert_allclose(corrected, exact, atol=1e-6)
    assert np.abs(angles - ANGLES).max() < 0.3


def test_beams_without_distance():
    ranges, poses = np.array([np.inf, -np.inf, 0.0, 2.0]), np.linspace([0, 0, 0], [0.1, 0, 0.2], 4)
    corrected, angles = correct_beams(ranges, np.arange(4.0), poses, np.zeros(3))
    np.testing.assert_array_equal(corrected[:3], ranges[:3])
    np.testing.assert_allclose(angles[:3], np.arange(3.0) + poses[:3, 2])


@pytest.mark.parametrize(("increment", "times"), [(0.5, [0, 0.5, 1]), (-0.5, [1, 0.5, 0]), (0.0, [0, 0, 0])])
def test_times_of_beams(increment, times):
    assert beam_times(3, increment).tolist() == times


def test_corrected_scan_has_even_beams():
    start, velocity, mount = np.array([3.0, 2.5, 0.4]), np.array([0.8, -0.4, 1.5]), np.array([0.2, 0.1, 0.3])
    ranges, _ = swept(start, velocity, mount)
    ranges[100:120] = np.inf
    scan = Scan(
        stamp_ns=0,
        angle_min=ANGLES[0],
        angle_increment=ANGLES[1] - ANGLES[0],
        range_min=0.05,
        range_max=25.0,
        ranges=ranges.astype(np.float32),
        mount=Pose.of(mount),
        time_increment=INCREMENT,
    )
    corrected = correct_scan(scan, velocity)
    exact = HALL.ray_distances(se2.compose(start, mount)[None], ANGLES)[0]
    measured = np.isfinite(corrected.ranges) & (corrected.ranges > 0)
    assert measured.sum() > 260
    assert np.abs(corrected.ranges - exact)[measured].max() < 0.1  # half a beam, where a wall is grazed
    assert np.isinf(corrected.ranges[105:115]).all()
    assert correct_scan(scan.model_copy(update={"time_increment": 0.0}), velocity).ranges is scan.ranges
