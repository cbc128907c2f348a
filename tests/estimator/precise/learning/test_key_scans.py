"""Which scans are learned from while driving."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import World
from common.robot.motion_distortion import beam_times
from services.estimator.precise.learning import key_scans
from services.estimator.precise.learning.key_scans import KeyScanCollector
from services.estimator.shared.interface import Hypothesis, Observation, Posterior

ANGLES = np.linspace(-2.0, 2.0, 81)
MOUNT = np.array([0.1, 0.0, 0.0])
PERIOD_S, SPEED = 0.1, 0.5


def posterior(pose, state="tracking", protection=(0.02, 0.02, 0.01)):
    zero = np.zeros(3)
    hypothesis = Hypothesis(np.asarray(pose, float), np.eye(3), 1.0)
    level = None if protection is None else np.array(protection)
    return Posterior(state, (hypothesis,), 0.0, 0.0, zero, np.eye(3), np.ones(81), protection=level)


class Drive:
    """Drives along x, and tells the key scans of it."""

    def __init__(self):
        self.keys = KeyScanCollector(ANGLES, MOUNT, 10.0)
        self.stamp, self.x = 0.0, 0.0

    def go(self, metres, **changes):
        for _ in range(round(metres / (SPEED * PERIOD_S))):
            self.x += SPEED * PERIOD_S
            self.scan(posterior([self.x, 0.0, 0.0], **changes))
        return self

    def scan(self, after, ranges=None):
        self.stamp += PERIOD_S
        ranges = np.full(81, 2.0 + self.x) if ranges is None else ranges
        self.keys.add(after, Observation(ranges, ANGLES, 10.0, self.stamp))


def test_verified_after_driving_on():
    drive = Drive().go(4.9)
    assert len(drive.keys) == 0
    drive.go(3.0)
    places = sorted(key.pose[0] for key in drive.keys.verified.values())
    assert len(places) == pytest.approx(3.0 / key_scans.PLACE_M, abs=1)
    assert max(places) < drive.x - key_scans.VERIFIED_AFTER_M + 0.01
    assert drive.keys.dropped_total == 0


def test_standing_robot_verifies_nothing():
    """Noise makes its pose wander, but it does not drive."""
    drive, rng = Drive().go(3.0), np.random.default_rng(0)
    for _ in range(3000):
        drive.scan(posterior([drive.x + 0.003 * rng.standard_normal(), 0.0, 0.0]))
    assert not drive.keys.verified


def test_corrected_poses():
    """The poses found in learning replace those of the same scans only, also where newer scans came since."""
    drive = Drive().go(8.0)
    before = {key.stamp: key.pose for key in drive.keys.verified.values()}
    drive.go(3.0)
    drive.keys.set_learned(np.array(list(before)), np.array(list(before.values())) + np.array([0.01, 0.0, 0.0]))
    for key in drive.keys.verified.values():
        x = before[key.stamp][0] + 0.01 if key.stamp in before else round(key.pose[0], 2)
        assert key.pose[0] == pytest.approx(x)
    assert len(drive.keys) > len(before)
    assert drive.keys.learned_until == max(before)


@pytest.mark.parametrize("changes", [{"state": "ambiguous"}, {"protection": None}, {"protection": (0.02, 0.3, 0.01)}])
def test_untrusted_poses(changes):
    drive = Drive().go(8, **changes)
    drive.go(8)
    assert drive.keys.verified
    assert min(key.pose[0] for key in drive.keys.verified.values()) > 8


def test_kidnapped():
    """What was seen at a pose that turns out to be wrong is dropped, and only that."""
    drive = Drive().go(8)
    before = dict(drive.keys.verified)
    drive.x = 40.0
    drive.go(4)
    assert drive.keys.verified == before
    assert drive.keys.dropped_total > 10
    drive.go(4)
    assert all(key.pose[0] < 3.1 or key.pose[0] > 40 for key in drive.keys.verified.values())


def test_lost_for_long():
    drive = Drive().go(8)
    verified = len(drive.keys)
    drive.stamp += key_scans.MAX_GAP_S
    drive.go(4.5)
    assert len(drive.keys) == verified
    assert drive.keys.dropped_total > 10


def test_one_scan_without_tracking():
    drive = Drive().go(4)
    drive.scan(posterior([4.0, 0.0, 0.0], "localising"))
    drive.go(4)
    assert drive.keys.dropped_total == 0
    assert drive.keys.verified


def test_restart_of_time():
    drive = Drive().go(8)
    drive.stamp = 0.0
    drive.go(1)
    assert drive.keys.dropped_total > 10


def test_stamps_that_begin_again():
    """Scans after a reset of the simulator are newer than those before, and are not mixed up with them."""
    drive = Drive().go(12)
    stamps, poses = (
        np.array(each) for each in zip(*((k.stamp, k.pose) for k in drive.keys.verified.values()), strict=True)
    )
    drive.keys.set_learned(stamps, poses)
    drive.stamp = 0.0
    drive.go(12)
    added = [key for key in drive.keys.verified.values() if key.pose[0] > 12]
    assert len(added) > 10
    assert min(key.stamp for key in added) > drive.keys.learned_until
    drive.keys.set_learned(stamps, poses + np.array([5.0, 0.0, 0.0]))
    assert all(drive.keys.verified[key.cell(key_scans.PLACE_M)] == key for key in added)


def test_newest_of_each_place():
    drive = Drive().go(12)
    first = len(drive.keys)
    drive.x = 0.0
    drive.go(12)
    assert len(drive.keys) == first
    assert min(key.stamp for key in drive.keys.verified.values()) > 12 / SPEED


def test_bounded_memory(monkeypatch):
    monkeypatch.setattr(key_scans, "MAX_KEY_SCANS", 20)
    drive = Drive().go(100)
    assert 8 < len(drive.keys) <= 20
    places = sorted(key.pose[0] for key in drive.keys.verified.values())
    assert places[0] < 10  # coarser, but nothing is forgotten
    assert np.diff(places).max() < 20


def test_drive_when_enough_is_new():
    drive = Drive().go(20)
    assert drive.keys.take_drive() is None
    drive.go(20)
    taken = drive.keys.take_drive()
    assert len(taken.poses) == len(drive.keys) >= key_scans.MIN_KEY_SCANS
    assert (np.diff(taken.stamps) > 0).all()
    assert drive.keys.take_drive() is None
    drive.go(15)
    assert len(drive.keys.take_drive().poses) > len(taken.poses)


def test_replaced_scans_are_not_new():
    """A robot that drives to and fro at a few places replaces their key scans, but has few new ones."""
    drive = Drive().go(35)
    assert drive.keys.take_drive() is not None
    for _ in range(5):
        drive.x = 20.0
        drive.go(9)
    assert drive.keys.take_drive() is None
    drive.x = 5.0
    drive.go(20)
    assert drive.keys.take_drive() is not None


def test_correction_for_motion():
    """Ranges are those at the stamp, although the robot drives on while the scanner turns."""
    world = World(name="w", boundary=[(-20, -2), (20, -2), (20, 2), (-20, 2)])
    keys, increment, turn = KeyScanCollector(ANGLES, MOUNT, 30.0), 0.08 / 80, 1.0
    times = beam_times(81, increment)
    for k in range(100):
        pose = np.array([0.1 * k, 0.0, 0.1 * turn * k])
        moved = se2.compose(pose, times[:, None] * se2.between(pose, [0.1 * (k + 1), 0.0, 0.1 * turn * (k + 1)]) / 0.1)
        lasers = se2.compose(moved, MOUNT)
        ranges = np.array([world.ray_distances(lasers[b : b + 1], ANGLES[b : b + 1])[0, 0] for b in range(81)])
        keys.add(posterior(pose), Observation(
            ranges, ANGLES, 30.0, 0.1 * k, time_increment=increment
        ))  # fmt: skip
    for key in keys.verified.values():
        exact = world.ray_distances(se2.compose(key.pose, MOUNT)[None], ANGLES)[0]
        near = np.isfinite(key.ranges) & (exact < 4)
        assert near.sum() > 20
        assert np.median(np.abs(key.ranges - exact)[near]) < 0.03
