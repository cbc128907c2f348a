"""Beams that hit the robot itself are masked, and no others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry import se2
from common.messages.definitions import Scan
from common.robot.motion_distortion import correct_scan
from common.robot.ranges import is_surface
from common.robot.scan_geometry import ALL_ROUND, Sweep
from common.robot.self_filter import MIN_TRIMMED_SECTOR_RAD, SelfFilter
from common.runtime import safety
from common.runtime.config import load_settings
from services.bridge_ros2.settings import BridgeRos2Settings
from services.controller.settings import ControllerSettings

STANDING = np.zeros(3)


def scan(beams=360, first=-180.0, step=1.0, ranges=None):
    ranges = 1 + np.arange(beams) / 1000 if ranges is None else ranges
    return Scan(
        stamp_ns=0, angle_min=np.deg2rad(first), angle_increment=np.deg2rad(step), range_min=0.1, range_max=10.0,
        ranges=ranges,
    )  # fmt: skip


def blind(**settings):
    return ControllerSettings(**settings).build_self_filter()


def degrees(found):
    return np.rad2deg(se2.wrap(found.angles()))


def test_inactive_by_default():
    for settings in (ControllerSettings(), BridgeRos2Settings()):
        whole = scan()
        assert (
            settings.build_self_filter().correct_and_mask(whole, STANDING)
            is settings.build_self_filter().mask_for_bus(whole)
            is whole
        )


def test_narrow_sectors_are_masked():
    """Bounds are included; masked beams are 0 in published scans and NaN for planning."""
    cut = blind(ignore_angles="-92:-88,44:46")
    for found, value in ((cut.mask_for_bus(scan()), 0.0), (cut.correct_and_mask(scan(), STANDING), np.nan)):
        hidden = ~is_surface(found.ranges)
        np.testing.assert_allclose(degrees(found)[hidden], [-92, -91, -90, -89, -88, 44, 45, 46])
        np.testing.assert_array_equal(found.ranges[hidden], np.float32(value))
        np.testing.assert_array_equal(found.ranges[~hidden], scan().ranges[~hidden])
        assert Sweep.of(found).sector(0.0) == ALL_ROUND  # a post does not reduce the field of view
    assert Scan.decode(cut.mask_for_bus(scan()).encode()) == cut.mask_for_bus(scan())
    assert len(safety.scan_points(cut.correct_and_mask(scan(), STANDING))) == 360 - 8


def test_beams_within_the_radius_are_masked():
    ranges = [-np.inf, 0.1, 0.19, 0.2, 0.25, 3.0, np.inf]
    found = blind(blind_radius=0.2).correct_and_mask(scan(7, ranges=ranges), STANDING)
    np.testing.assert_array_equal(found.ranges, np.float32([np.nan, np.nan, np.nan, 0.2, 0.25, 3, np.inf]))
    zero = blind(blind_radius=0.2).mask_for_bus(scan(3, ranges=[0.0, 0.1, 1.0]))
    np.testing.assert_array_equal(zero.ranges, np.float32([0, 0, 1]))  # 0 is no distance
    found = blind(ignore_angles="1:2").correct_and_mask(scan(7, ranges=ranges), STANDING)
    np.testing.assert_array_equal(found.ranges, np.float32(ranges))  # nothing too close is cut out without


@pytest.mark.parametrize("text", ["135:225", "-225:-135", "135:180,-180:-135"])
def test_wide_sectors_at_the_ends(text):
    """Full-circle scans lose the sector behind the robot, in any notation of its bounds."""
    found = blind(ignore_angles=text).correct_and_mask(scan(), STANDING)
    view = Sweep.of(found).sector(0.0)
    assert view.centre == pytest.approx(0, abs=0.02)
    assert np.rad2deg(view.half) == pytest.approx(134.5, abs=1)
    whole = dict(zip(degrees(scan()).round(), scan().ranges, strict=True))
    assert [whole[at] for at in degrees(found).round()] == list(found.ranges)


def test_wide_sectors_in_the_middle():
    found = blind(ignore_angles="90:140").correct_and_mask(scan(271, -135), STANDING)
    assert degrees(found)[[0, -1]] == pytest.approx([-135, 89])
    found = blind(ignore_angles="-25:25").correct_and_mask(scan(271, -135), STANDING)
    assert len(found.ranges) == 271
    assert np.isnan(found.ranges).sum() == 51


@pytest.mark.parametrize(("beams", "first", "step"), [(361, -180.0, 1.0), (360, 0.0, 360 / 359)])
def test_last_beam_in_the_direction_of_the_first(beams, first, step):
    whole = scan(beams, first, step)
    found = blind(ignore_angles="60:120").correct_and_mask(whole, STANDING)
    seen = dict(zip(degrees(whole)[:-1].round(2) % 360, whole.ranges, strict=False))
    assert [seen[at] for at in degrees(found).round(2) % 360] == list(found.ranges)


def test_motion_during_a_scan_without_its_wide_sector():
    """The remaining beams are corrected for the motion as without a filter, and the scan takes as long."""
    turning = scan(first=0.0).model_copy(update={"time_increment": 0.1 / 360})
    velocity = np.array([0.5, 0.0, 2.0])
    found = blind(ignore_angles="135:225").correct_and_mask(turning, velocity)
    corrected = correct_scan(turning, velocity)
    expected = dict(zip(degrees(corrected).round(), corrected.ranges, strict=True))
    front = np.abs(degrees(found)) < 120  # away from the sector, the beams of which are left out
    assert front.sum() == 239
    assert list(found.ranges[front]) == [expected[at] for at in degrees(found)[front].round()]
    assert found.sweep_time == pytest.approx(turning.sweep_time)


bounds = st.tuples(st.floats(-300, 300), st.floats(0.1, 59)).map(lambda pair: (pair[0], pair[0] + pair[1]))


@given(st.lists(bounds, max_size=5), st.sampled_from([(360, -180.0, 1.0), (181, 90.0, -1.0), (720, 0.0, 0.5)]))
def test_directions_outside_the_sectors(sectors, sweep):
    """Remaining beams keep their directions, and only beams in the sectors are removed or masked."""
    whole = scan(*sweep)
    found = SelfFilter(tuple(tuple(np.deg2rad(each)) for each in sectors)).correct_and_mask(whole, STANDING)
    before = {round(at, 3) % 360: r for at, r in zip(degrees(whole), whole.ranges, strict=True)}
    after = {round(at, 3) % 360: r for at, r in zip(degrees(found), found.ranges, strict=True)}
    assert after.keys() <= before.keys()
    for at, r in before.items():
        inside = any((at - low + 1e-4) % 360 <= high - low + 2e-4 for low, high in sectors)
        assert after[at] == r if at in after and not np.isnan(after[at]) else inside, at
    gone = len(before) - len(after)
    assert not gone or gone * abs(whole.angle_increment) > 0.9 * MIN_TRIMMED_SECTOR_RAD


@pytest.mark.parametrize("text", ["10:5", "0:0", "0:400", "-170:0,0:190", "1", "1:2:3", "a:b", "nan:1"])
@pytest.mark.parametrize("settings", [ControllerSettings, BridgeRos2Settings])
def test_invalid_bounds_are_refused(settings, text):
    with pytest.raises(UserError, match=r"ignore.angles"):
        load_settings(settings, [f"--ignore-angles={text}"]).build_self_filter()


@pytest.mark.parametrize("radius", ["-1", "nan", "inf", "6"])
def test_invalid_radii_are_refused(radius):
    with pytest.raises(UserError, match="--blind-radius, PRESAGE_BLIND_RADIUS"):
        load_settings(ControllerSettings, [f"--blind-radius={radius}"])
