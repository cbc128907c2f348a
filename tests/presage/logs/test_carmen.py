"""CARMEN logs: every kind of line, compression, and what goes wrong in real ones."""

from __future__ import annotations

import bz2
import gzip
import lzma

import numpy as np
import pytest

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from presage.logs.log import Reading
from presage.logs.opening import HEAD_BYTES, kind_of, open_log
from tests.presage.logs.drives import ANGLES, BEAMS, MOUNT, SCANS, STAMPS, carmen, odom, ranges, truth, words

FOV = {"angles": (ANGLES[0], ANGLES[-1])}  # FLASER's 91 beams are no usual number


def write(tmp_path, lines, pack=None, name="drive.log"):
    text = ("\n".join(lines) + "\n").encode()
    file = tmp_path / name
    file.write_bytes(pack.compress(text) if pack is not None else text)
    return file


def read(path, **options):
    log = open_log(path, Reading(**options))
    return log, list(log.valid_scans())


def close(poses, wanted):
    np.testing.assert_allclose(np.array(poses), wanted, atol=2e-6)


@pytest.mark.parametrize("kind", ["FLASER", "ROBOTLASER1", "OLD", "RAWLASER1"])
def test_kinds_of_lines(tmp_path, kind):
    options = FOV if kind == "FLASER" else {}
    options |= {"mount": MOUNT} if kind == "RAWLASER1" else {}
    log, sweeps = read(write(tmp_path, carmen(kind)), **options)
    assert log.scans == SCANS
    kept = sweeps[:-1] if kind == "RAWLASER1" else sweeps  # no ODOM comes after the last scan
    np.testing.assert_allclose([sweep.stamp_ns for sweep in sweeps], STAMPS, atol=1000)
    np.testing.assert_allclose([sweep.ranges for sweep in sweeps], ranges(), atol=1e-6)
    np.testing.assert_allclose(log.angles, ANGLES, atol=1e-6)
    np.testing.assert_allclose(log.mount, MOUNT, atol=1e-5)  # by the two poses of a line
    close([sweep.odom for sweep in kept], odom(STAMPS)[: len(kept)])
    assert len(kept) == SCANS or sweeps[-1].odom is None
    assert log.range_max == 25.0
    assert not log.reference


@pytest.mark.parametrize("pack", [gzip, bz2, lzma])
def test_compressed(tmp_path, pack):
    """A block of bzip2 is up to 900 kB: the first 64 KiB of such a file hold no whole one."""
    rng = np.random.default_rng(0)
    lines = [f"FLASER 361 {words(row)} 0 0 0 0 0 0 {k} h {k}" for k, row in enumerate(rng.uniform(1, 9, (150, 361)))]
    file = write(tmp_path, lines, pack, "drive.clf.packed")
    assert file.stat().st_size > 2 * HEAD_BYTES
    assert kind_of(file) == "carmen"
    assert len(read(file)[1]) == 150
    whole = file.read_bytes()
    for share in (0.1, 0.99):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(UserError, match="cut short or damaged"):
            read(file)
    file.write_bytes(pack.compress(b"a letter\n"))
    with pytest.raises(UserError, match="compressed, and no CARMEN log is inside"):
        read(file)


def test_odom_lines(tmp_path):
    log, sweeps = read(write(tmp_path, carmen("ROBOTLASER1")), odom_topic="ODOM")
    assert log.odometry == "ODOM, interpolated"
    close([sweep.odom for sweep in sweeps[1:-1]], odom(STAMPS)[1:-1])


def test_corrected_poses(tmp_path):
    file = write(tmp_path, carmen("FLASER", corrected=True, header=f"PARAM robot_frontlaser_offset {MOUNT[0]} h 0"))
    assert not read(file, **FOV)[0].reference
    log, sweeps = read(file, **FOV, reference=True, mount=MOUNT)
    assert log.reference == "FLASER's corrected pose"
    close([sweep.reference for sweep in sweeps], truth(STAMPS))
    assert read(file, **FOV)[0].mount.tolist() == [MOUNT[0], 0, 0]  # the poses do not tell; PARAM does
    raw, _ = read(write(tmp_path, carmen("FLASER")), **FOV, reference=True)
    assert not raw.reference
    assert any("no reference" in note for note in raw.notes)


def test_truepos_lines(tmp_path):
    lines = carmen()
    lines += [f"TRUEPOS {words(truth(s))} {words(odom(s))} {s * 1e-9:.6f} host {k / 10}" for k, s in enumerate(STAMPS)]
    log, sweeps = read(write(tmp_path, lines))
    assert log.reference == "the log's TRUEPOS"
    np.testing.assert_allclose([sweep.reference for sweep in sweeps], truth(STAMPS), atol=1e-5)
    assert not read(tmp_path / "drive.log", reference=False)[0].reference


@pytest.mark.parametrize(
    ("beams", "first", "last"), [(180, -90, 89), (181, -90, 90), (360, -90, 89.5), (361, -90, 90), (541, -135, 135)]
)
def test_angles_by_number_of_beams(tmp_path, beams, first, last):
    line = f"FLASER {beams} {words(np.full(beams, 2.0))} 0 0 0 0 0 0 {{}} host 0.1"
    log, _ = read(write(tmp_path, [line.format(1.0), line.format(2.0)]))
    np.testing.assert_allclose(np.rad2deg(log.angles[[0, -1]]), [first, last])
    assert any("angles in section log" in note for note in log.notes)


def test_unknown_angles(tmp_path):
    with pytest.raises(UserError, match="the angles of its 100 beams"):
        read(write(tmp_path, [f"FLASER 100 {words(np.full(100, 2.0))} 0 0 0 0 0 0 1.0 host 0.1"]))


@pytest.mark.parametrize(
    ("stated", "longest", "range_max"),
    [
        (None, 81.91, 80.0), (None, 8.191, 8.18), (None, 5.0, 80.0), (81.92, 81.91, 80.0), (81.83, 81.83, 80.0),
        (80.0, 81.9, 80.0), (8.19, 8.187, 8.18), (81.9, 8.187, 8.18), (30.0, 8.187, 30.0), (81.92, 7.5, 80.0),
    ],
)  # fmt: skip
def test_maximum_range_of_an_lms(tmp_path, stated, longest, range_max):
    """What a header states is the highest code of the scanner, and not a distance."""
    row = np.full(181, 2.0)
    row[3] = longest
    line = f"FLASER 181 {words(row)} 0 0 0 0 0 0 1.0 host 0.1"
    if stated is not None:
        head = f"0 -1.570796 3.141593 0.0174533 {stated} 0.01 0 181 {words(row)} 0"
        line = f"ROBOTLASER1 {head} 0 0 0 0 0 0 0 0 0 0 0 1.0 host 0.1"
    log, scans = read(write(tmp_path, [line]))
    assert log.range_max == range_max
    assert np.isinf(scans[0].ranges[3]) == (longest >= range_max)
    assert any("range_max" in note for note in log.notes) == (stated != range_max)


@pytest.mark.parametrize(
    ("stated", "longest", "range_max"),
    [(81.9, 81.83, 80.0), (8.19, 8.187, 8.18), (50.0, 8.187, 8.18), (30.0, 12.0, 30.0)],
)
def test_maximum_range_in_a_parameter(tmp_path, stated, longest, range_max):
    row = np.full(181, 2.0)
    row[3] = longest
    line = f"FLASER 181 {words(row)} 0 0 0 0 0 0 1.0 host 0.1"
    log, scans = read(write(tmp_path, [f"PARAM robot_front_laser_max {stated} h 0", line]))
    assert log.range_max == range_max
    assert np.isinf(scans[0].ranges[3]) == (longest >= range_max)


@pytest.mark.parametrize(("name", "range_max"), [("FLASER", 20.0), ("RLASER", 10.0), ("LASER3", 80.0)])
def test_parameters_of_lasers(tmp_path, name, range_max):
    line = f"{name} 181 {words(np.full(181, 2.0))} {{0}} 0 0 0 0 0 {{0}} host {{0}}"  # its poses are corrected
    params = [
        "PARAM robot_front_laser_max 20 h 0", "PARAM robot_rear_laser_max 10 h 0",
        "PARAM robot_frontlaser_offset 0.3 h 0", "PARAM robot_rearlaser_offset -0.4 h 0",
    ]  # fmt: skip
    log, _ = read(write(tmp_path, [*params, line.format(1), line.format(2)]))
    assert log.range_max == range_max
    assert log.mount[0] == {"FLASER": 0.3, "RLASER": -0.4, "LASER3": 0.0}[name]
    assert log.mount_assumed == (name == "LASER3")  # no PARAM states it
    assert log.mount[2] == (np.pi if name == "RLASER" else 0.0)
    params += ["PARAM robot_frontlaser_angular_offset 0.1 h 0", "PARAM robot_rearlaser_angular_offset 3.1 h 0"]
    log, _ = read(write(tmp_path, [*params, line.format(1), line.format(2)]))
    assert log.mount[2] == {"FLASER": 0.1, "RLASER": 3.1, "LASER3": 0.0}[name]


def test_malformed_poses_cost_no_scan(tmp_path):
    lines = carmen()
    poses = [k for k, line in enumerate(lines) if line.startswith("ODOM")]
    lines[poses[2]] = "ODOM 1 2"
    lines[poses[4]] = lines[poses[4]].replace("ODOM ", "ODOM x")
    lines.insert(7, "TRUEPOS nan 0 0 0 0 0 1 h 1")
    log, scans = read(write(tmp_path, lines))
    assert len(scans) == SCANS
    assert log.describe_left_out() == "malformed ODOM lines: 2, malformed TRUEPOS lines: 1"
    assert not log.left_out


def test_two_lasers(tmp_path):
    rear = "RLASER 181 " + words(np.full(181, 3.0)) + " -0.2 0 3.141593 0 0 0 {0} host {0}"
    lines = [*carmen("ROBOTLASER1"), *(rear.format(k) for k in (1, 2, 3))]
    file = write(tmp_path, lines)
    assert len(read(file)[1]) == SCANS
    log, sweeps = read(file, scan_topic="RLASER")
    assert len(sweeps) == 3
    np.testing.assert_allclose(np.abs(log.mount), [0.2, 0, np.pi], atol=1e-6)
    with pytest.raises(UserError, match="no FLASER lines in it; it has RLASER, ROBOTLASER1"):
        read(file, scan_topic="FLASER")


def test_unusable_scans_are_counted(tmp_path):
    lines = carmen()
    scans = [k for k, line in enumerate(lines) if line.startswith("ROBOTLASER1")]
    lines[scans[3]] = lines[scans[3]][:200]  # cut in the middle
    lines[scans[5]] = lines[scans[4]]  # twice
    lines[scans[8]] = lines[scans[6]]  # late
    short = lines[scans[9]].split()
    lines[scans[9]] = " ".join([*short[:8], "30", *short[9 : 9 + 30], *short[9 + BEAMS :]])
    lines.insert(4, "\x1b[0m garbage")
    lines.insert(9, "GPS 1 2 3 of no interest")
    log, sweeps = read(write(tmp_path, lines))
    assert dict(log.left_out) == {
        "malformed lines": 2, "scans twice": 1, "scans older than the one before": 1, "scans with other beam angles": 1,
    }  # fmt: skip
    assert len(sweeps) == SCANS - 4
    assert list(log.valid_scans())  # the counts are of the last pass
    assert log.left_out["malformed lines"] == 2


def test_interlaced_scanner(tmp_path):
    lines, quarter = carmen(), np.deg2rad(0.5)
    scans = [k for k, line in enumerate(lines) if line.startswith("ROBOTLASER1")]
    lasers = se2.compose(truth(STAMPS), MOUNT)
    turned = load_world("corridor").ray_distances(lasers, ANGLES[:-1] + quarter)
    for k, row in list(zip(scans, turned, strict=True))[1::2]:
        parts = lines[k].split()
        parts[2] = f"{ANGLES[0] + quarter:.8f}"
        lines[k] = " ".join([*parts[:8], str(BEAMS - 1), words(row), *parts[9 + BEAMS :]])
    file = write(tmp_path, lines)
    log, sweeps = read(file)
    assert not log.left_out
    assert "6 scans with other beam angles are resampled at the angles of the first scan" in log.notes
    off = np.abs([sweep.ranges for sweep in sweeps] - ranges())[1::2, 1:-1]
    assert np.quantile(off, 0.9) < 0.05  # at edges a ray half a spacing aside sees another surface
    upside_down = read(file, upside_down=True)
    note = "the scanner is mounted upside down: the order of its beams is reversed"
    assert upside_down[0].notes == [note, log.notes[-1]]
    np.testing.assert_array_equal(upside_down[1][1].ranges, sweeps[1].ranges[::-1])
    assert read(file, angles=(ANGLES[0], ANGLES[-1]))[0].left_out == {"scans with other beam angles": 6}


def test_refusals(tmp_path):
    cut = [line[:80] if line.startswith("ROBOT") and k > 8 else line for k, line in enumerate(carmen())]
    without_odom = [line for line in carmen() if not line.startswith("ODOM")]
    for lines, odom_topic, why in (
        (cut, "", "too few usable scans: 3; left out: malformed lines: 9"),
        (["ODOM 0 0 0 0 0 0 1 h 1"], "", "without scans"),
        (carmen(), "ODOMETRY", r"odom.topic ODOMETRY: .* only have ODOM, and this one has ODOM lines"),
        (without_odom, "ODOM", "no ODOM lines"),
    ):
        with pytest.raises(UserError, match=why):
            read(write(tmp_path, lines), odom_topic=odom_topic)


def test_clocks(tmp_path):
    file = write(tmp_path, carmen())
    _, sweeps = read(file, clock="logger")
    assert [sweep.stamp_ns for sweep in sweeps] == [k * 100_000_000 for k in range(SCANS)]
    still = [f"FLASER 181 {words(np.full(181, 2.0))} 0 0 0 0 0 0 0 nohost {k}" for k in range(5)]
    log, sweeps = read(write(tmp_path, still))
    assert [sweep.stamp_ns for sweep in sweeps] == [k * 10**9 for k in range(5)]
    assert any("do not advance" in note for note in log.notes)
