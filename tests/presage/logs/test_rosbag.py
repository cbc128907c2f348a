"""Bags of ROS 1 and 2, in every container and compression, written here and read back."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from presage.logs.log import Reading
from presage.logs.opening import open_log
from tests.presage.logs.drives import ANGLES, BEAMS, MOUNT, SCANS, STAMPS, Bag, believed, odom, ranges, truth, write_bag


def read(path, **said):
    log = open_log(path, Reading(**said))
    return log, list(log.sweeps())


def close(poses, wanted):
    np.testing.assert_allclose(np.array(poses), wanted, atol=1e-6)


@pytest.mark.parametrize(
    ("form", "compression"),
    [("ros1", ""), ("ros1", "bz2"), ("ros1", "lz4"), ("db3", ""), ("mcap", ""), ("db3", "file"), ("db3", "message")],
)
def test_every_container(tmp_path, form, compression):
    log, sweeps = read(write_bag(tmp_path, Bag(form, compression)))
    assert log.scans == len(sweeps) == SCANS
    assert [sweep.stamp_ns for sweep in sweeps] == STAMPS.tolist()  # the header's, not the logger's
    np.testing.assert_allclose([sweep.ranges for sweep in sweeps], ranges(), rtol=1e-6)
    np.testing.assert_allclose(log.angles, ANGLES, atol=1e-6)
    np.testing.assert_allclose(log.mount, MOUNT, atol=1e-6)
    close([sweep.odom for sweep in sweeps], odom(STAMPS))
    assert (log.range_max, log.range_min) == (25.0, pytest.approx(0.05))
    assert not log.reference
    assert not log.left_out


@pytest.mark.parametrize("suffix", ["db3", "mcap"])
def test_a_file_without_its_folder(tmp_path, suffix):
    folder = write_bag(tmp_path, Bag(suffix))
    (file,) = folder.glob(f"*.{suffix}")
    assert len(read(file)[1]) == SCANS
    renamed = file.rename(file.with_suffix(".log"))
    with pytest.raises(UserError, match=f"rename it to NAME.{suffix}"):
        read(renamed)


def test_a_scanner_that_hangs_upside_down(tmp_path):
    log, sweeps = read(write_bag(tmp_path, Bag(upside_down=True)))
    np.testing.assert_allclose(log.mount, MOUNT, atol=1e-6)
    np.testing.assert_allclose(log.angles, ANGLES, atol=1e-6)
    np.testing.assert_allclose([sweep.ranges for sweep in sweeps], ranges(), rtol=1e-6)
    assert any("upside down" in note for note in log.notes)


def test_beams_that_run_clockwise(tmp_path):
    scan = {"angle_min": ANGLES[-1], "angle_max": ANGLES[0], "angle_increment": ANGLES[0] - ANGLES[1]}
    log, sweeps = read(write_bag(tmp_path, Bag(scan=scan)))
    np.testing.assert_allclose(log.angles, ANGLES, atol=1e-5)
    np.testing.assert_allclose([sweep.ranges[::-1] for sweep in sweeps], ranges(), rtol=1e-6)


def test_ranges_as_rep_117_has_them(tmp_path):
    row = np.full(BEAMS, 5.0, np.float32)
    row[:7] = np.nan, np.inf, -np.inf, 0.0, 0.01, 25.0, 30.0
    _, sweeps = read(write_bag(tmp_path, Bag(scan={"ranges": row})))
    assert sweeps[0].ranges[:8].tolist() == [0, np.inf, -np.inf, 0, -np.inf, np.inf, np.inf, 5.0]


def test_the_longest_range_may_be_said(tmp_path):
    path = write_bag(tmp_path, Bag(scan={"range_max": np.inf}))
    with pytest.raises(UserError, match="--range-max"):
        read(path)
    assert read(path, range_max=3.0)[1][0].ranges.max() == np.inf


def test_the_reference_is_named_for_what_it_is(tmp_path):
    log, sweeps = read(write_bag(tmp_path, Bag(localised=True, more=("ground_truth",))), odom_topic="/odom")
    assert log.reference == "the log's own localisation (tf map -> base_link)"
    # Its map -> odom and odom -> base_link are interpolated each by itself, which is not quite their product.
    np.testing.assert_allclose([s.reference for s in sweeps], believed(STAMPS), atol=2e-4)
    path = tmp_path / "drive"
    log, sweeps = read(path, reference_topic="/ground_truth")  # of two odometries the other is the odometry
    assert log.reference == "the log's /ground_truth"
    close([sweep.reference for sweep in sweeps], truth(STAMPS))
    close([sweep.odom for sweep in sweeps], odom(STAMPS))
    log, sweeps = read(path, reference=False, odom_topic="/odom")
    assert not log.reference
    assert sweeps[0].reference is None


def test_odometry_from_tf_where_there_is_no_topic(tmp_path):
    log, sweeps = read(write_bag(tmp_path, Bag(odom=False)))
    assert log.odometry == "tf odom -> base_link, interpolated"
    close([sweep.odom for sweep in sweeps], odom(STAMPS))


def test_without_tf_the_mount_must_be_said(tmp_path):
    path = write_bag(tmp_path, Bag(tf=False))
    with pytest.raises(UserError, match="tf does not say where laser sits on base_link: say it with --mount"):
        read(path)
    assert read(path, mount=MOUNT)[0].mount is MOUNT


def test_several_scanners_and_odometries(tmp_path):
    path = write_bag(tmp_path, Bag(more=("scan2", "ground_truth")))
    with pytest.raises(UserError, match="--scan-topic: /scan, /scan2"):
        read(path)
    with pytest.raises(UserError, match="--odom-topic: /ground_truth, /odom"):
        read(path, scan_topic="/scan")
    with pytest.raises(UserError, match="--scan-topic /lidar: no topic"):
        read(path, scan_topic="/lidar")
    assert len(read(path, scan_topic="/scan2", odom_topic="/odom")[1]) == SCANS


def test_the_loggers_clock(tmp_path):
    _, sweeps = read(write_bag(tmp_path, Bag()), clock="logger")
    assert [sweep.stamp_ns for sweep in sweeps] == (STAMPS + 20_000_000).tolist()
    close([sweep.odom for sweep in sweeps], odom(STAMPS + 20_000_000))


def test_no_scan_in_it(tmp_path):
    path = write_bag(tmp_path, Bag(scan={"ranges": np.zeros(0, np.float32)}))
    with pytest.raises(UserError, match="/scan has no scan of three beams"):
        read(path)
