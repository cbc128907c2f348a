"""Bags of ROS 1 and 2."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from presage.logs.log import Reading
from presage.logs.opening import open_log
from presage.logs.resampling import resample
from tests.presage.logs.drives import ANGLES, BEAMS, MOUNT, SCANS, STAMPS, Bag, believed, odom, ranges, truth, write_bag


def read(path, **options):
    log = open_log(path, Reading(**options))
    return log, list(log.valid_scans())


def close(poses, wanted):
    np.testing.assert_allclose(np.array(poses), wanted, atol=1e-6)


@pytest.mark.parametrize(
    ("form", "compression"),
    [("ros1", ""), ("ros1", "bz2"), ("ros1", "lz4"), ("db3", ""), ("mcap", ""), ("db3", "file"), ("db3", "message")],
)
def test_containers(tmp_path, form, compression):
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
def test_file_without_its_folder(tmp_path, suffix):
    folder = write_bag(tmp_path, Bag(suffix))
    (file,) = folder.glob(f"*.{suffix}")
    assert len(read(file)[1]) == SCANS
    renamed = file.rename(file.with_suffix(".log"))
    with pytest.raises(UserError, match=f"rename it to NAME.{suffix}"):
        read(renamed)


@pytest.mark.parametrize("mounting", ["upside down", "clockwise"])
def test_reversed_beams(tmp_path, mounting):
    scan = {"angle_min": ANGLES[-1], "angle_max": ANGLES[0], "angle_increment": ANGLES[0] - ANGLES[1]}
    upside_down = mounting == "upside down"
    log, sweeps = read(write_bag(tmp_path, Bag(upside_down=True) if upside_down else Bag(scan=scan)))
    np.testing.assert_allclose(log.mount, MOUNT, atol=1e-6)
    np.testing.assert_allclose(log.angles, ANGLES, atol=1e-5)
    found = np.array([sweep.ranges for sweep in sweeps])
    np.testing.assert_allclose(found if upside_down else found[:, ::-1], ranges(), rtol=1e-6)
    assert any("upside down" in note for note in log.notes) == upside_down


def test_ranges(tmp_path):
    row = np.full(BEAMS, 5.0, np.float32)
    row[:7] = np.nan, np.inf, -np.inf, 0.0, 0.01, 25.0, 30.0
    path = write_bag(tmp_path, Bag(scan={"ranges": row}))
    expected = [0, np.inf, -np.inf, 0, -np.inf, np.inf, np.inf, 5.0]
    assert read(path)[1][0].ranges[:8].tolist() == expected
    assert read(path, range_max=3.0)[1][0].ranges[7] == np.inf


def test_reference(tmp_path):
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


@pytest.mark.parametrize(("upside_down", "expected"), [(False, 1e-5), (True, -1e-5)])
def test_times_of_beams(tmp_path, upside_down, expected):
    log, _ = read(write_bag(tmp_path, Bag(upside_down=upside_down, scan={"time_increment": 1e-5})))
    assert log.time_increment == pytest.approx(expected)


def test_odometry_from_tf(tmp_path):
    log, sweeps = read(write_bag(tmp_path, Bag(odom=False)))
    assert log.odometry == "tf odom -> base_link, interpolated"
    close([sweep.odom for sweep in sweeps], odom(STAMPS))


def test_odometry_of_an_unknown_frame(tmp_path):
    log, scans = read(write_bag(tmp_path, Bag(child="wheels")))
    (note,) = log.notes
    assert note.startswith("/odom has poses of wheels, and tf does not connect wheels and base_link")
    close([scan.odom for scan in scans], odom(STAMPS))
    with pytest.raises(UserError, match=r"odom.topic /odm: no topic of that name and type; it has /odom"):
        read(tmp_path / "drive", odom_topic="/odm")


def test_several_scanners_and_odometries(tmp_path):
    path = write_bag(tmp_path, Bag(more=("scan2", "ground_truth")))
    for topics, why in (
        ({}, "scan.topic.*: /scan, /scan2"),
        ({"scan_topic": "/scan"}, "odom.topic.*: /ground_truth, /odom"),
        ({"scan_topic": "/lidar"}, "scan.topic /lidar: no topic"),
    ):
        with pytest.raises(UserError, match=why):
            read(path, **topics)
    assert len(read(path, scan_topic="/scan2", odom_topic="/odom")[1]) == SCANS


@pytest.mark.parametrize(
    ("bag", "fact", "why"),
    [
        (
            Bag(tf=False),
            {"mount": MOUNT},
            "tf does not state where laser is mounted on base_link: give it",
        ),
        (Bag(scan={"range_max": np.inf}), {"range_max": 3.0}, "range.max"),
        (Bag(scan={"ranges": np.zeros(0, np.float32)}), None, "/scan has no scan with at least three beams"),
    ],
    ids=["mount", "maximum range", "scans"],
)
def test_missing_facts(tmp_path, bag, fact, why):
    path = write_bag(tmp_path, bag)
    with pytest.raises(UserError, match=why):
        read(path)
    assert fact is None or len(read(path, **fact)[1]) == SCANS


def test_clock_of_the_logger(tmp_path):
    _, sweeps = read(write_bag(tmp_path, Bag()), clock="logger")
    assert [sweep.stamp_ns for sweep in sweeps] == (STAMPS + 20_000_000).tolist()
    close([sweep.odom for sweep in sweeps], odom(STAMPS + 20_000_000))


def test_scans_of_other_beams_are_counted(tmp_path):
    def turn(k):
        if k == 1:  # too few beams, far apart
            return {"ranges": np.ones(9, np.float32), "angle_increment": np.pi / 8}
        if k == 2:  # looks elsewhere
            return {"angle_min": np.pi / 2, "angle_max": 3 * np.pi / 2}
        return {"ranges": np.ones(1, np.float32)} if k == 3 else {}

    log, scans = read(write_bag(tmp_path, Bag(each=turn)))
    assert len(scans) == SCANS - 3
    assert dict(log.left_out) == {"scans of other beams": 2, "scans without beams": 1}


def test_rounded_angles(tmp_path):
    step = ANGLES[1] - ANGLES[0]
    log, scans = read(write_bag(tmp_path, Bag(each=lambda k: {"angle_increment": step * (1 + 1e-7 * k)})))
    np.testing.assert_allclose([scan.ranges for scan in scans], ranges(), rtol=1e-6)
    assert not log.left_out
    assert not any("other beams" in note for note in log.notes)


@given(st.integers(20, 400), st.floats(0.3, 0.9), st.floats(-np.pi, np.pi))
def test_resampling_in_a_round_room(beams, share, first):
    """All round, from any first direction on; never a range that neither neighbour has."""
    angles = first + 2 * np.pi / beams * np.arange(beams)
    wanted = -np.pi + 2 * np.pi / 90 * np.arange(90)
    found = resample(np.where(np.arange(beams) / beams < share, 2.0, 7.0), angles, wanted)
    if beams < 90 / 4:
        assert found is None
    else:
        assert set(found.tolist()) <= {2.0, 7.0}
