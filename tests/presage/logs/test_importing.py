"""`presage import`: the recording of a log."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.topics import ODOM, SCAN, TRUTH
from common.runtime.config import load_section
from presage.logs.importing import ImportOptions, import_command
from presage.logs.log import Reading
from presage.logs.options import LogSettings
from presage.logs.scan_files import read_scans
from presage.recordings.info import collect_facts
from presage.recordings.session_figure import draw_session
from presage.replay.localize import LocalizeOptions, build_estimator_options, localize
from services.recorder.reader import read_recording
from tests.presage.logs.drives import (
    ANGLES,
    MOUNT,
    SCANS,
    STAMPS,
    Bag,
    believed,
    carmen,
    odom,
    ranges,
    truth,
    write_bag,
)

CONSOLE = Console(quiet=True)


def npz(folder, **changes):
    values = {
        "ranges": ranges(), "angles": ANGLES, "range_max": 25.0, "stamps": STAMPS * 1e-9, "odom": odom(STAMPS),
        "reference": truth(STAMPS),
    }  # fmt: skip
    file = folder / "drive.npz"
    np.savez(file, **{name: value for name, value in {**values, **changes}.items() if value is not None})
    return file


def imported(file, out="out.mcap", **more):
    job = ImportOptions(file, file.parent / out, **more)
    import_command(job, file.parent / "facts.json", CONSOLE, CONSOLE)
    return job.out, json.loads((file.parent / "facts.json").read_text())


def make(folder, name):
    if name == "carmen":
        file = folder / "drive.log"
        file.write_text("\n".join(carmen()) + "\n")
        return file
    return npz(folder) if name == "npz" else write_bag(folder, Bag(name, localised=True))


@pytest.mark.parametrize("name", ["carmen", "npz", "ros1", "db3", "mcap"])
def test_recording_equals_log(tmp_path, name):
    file = make(tmp_path, name)
    reading = Reading(mount=MOUNT) if name == "npz" else Reading()
    out, facts = imported(file, reading=reading, world="corridor")
    log, recorded = read_scans(file, reading.mount), read_scans(out)
    assert [scan.stamp for scan in log[1:3]] == [log[1].stamp, log[2].stamp]
    np.testing.assert_allclose(recorded.ranges, log.ranges, rtol=1e-6)
    np.testing.assert_allclose(recorded.geometry.angles, log.geometry.angles, atol=1e-6)
    np.testing.assert_allclose(recorded.geometry.mount, MOUNT, atol=1e-5)
    np.testing.assert_allclose(recorded.stamps, log.stamps)
    np.testing.assert_allclose(recorded.odom, odom(STAMPS), atol=1e-5)
    assert (recorded.truth is None) == (log.truth is None) == (name == "carmen")
    if name != "carmen":
        assert recorded.truth_is == log.truth_is != "the recorded truth"
        np.testing.assert_allclose(recorded.truth, log.truth)
        wanted = truth(STAMPS) if name == "npz" else believed(STAMPS)
        np.testing.assert_allclose(recorded.truth, wanted, atol=2e-4)
    assert recorded.world == "corridor"
    assert facts["scans"] == SCANS


def test_recording_is_complete(tmp_path):
    out, _ = imported(make(tmp_path, "mcap"), robot="truck")
    recording = read_recording(out)
    facts = collect_facts(recording, check=True)
    assert facts.complete
    assert facts.robots == ["truck"]
    assert facts.missing == 0
    assert {row.key: row.messages for row in facts.topics} == {t.key("truck"): SCANS for t in (SCAN, ODOM, TRUTH)}
    assert all(row.undecodable == 0 and row.counters["written"] == SCANS for row in facts.topics)
    about = recording.metadata["log"]
    assert about["format"] == "ROS 2 bag (/scan)"
    assert about["reference"] == "the log's own localisation (tf map -> base_link)"
    scanner = recording.scanner()
    assert (scanner.beams, scanner.rate) == (len(ANGLES), pytest.approx(10))
    assert scanner.mount == pytest.approx(tuple(MOUNT))
    assert recording.start_ns == STAMPS[0]


def test_velocities(tmp_path):
    out, _ = imported(npz(tmp_path), reading=Reading(mount=MOUNT))
    twists = [m.twist.array() for _, m, _ in read_recording(out).messages(TRUTH)]
    assert not twists[0].any()
    np.testing.assert_allclose(
        twists[1], se2.between(truth(STAMPS[0]), truth(STAMPS[1])) / 0.1, atol=1e-5
    )  # s in float64


def position_errors(file, world):
    estimator_options = build_estimator_options(file, world, "precise", "exact", None, 0.02, 0, "")
    options = {"odometry": True, "out": file.with_name("p.json")}
    rows = localize(LocalizeOptions.of(file, estimator_options, "track", "base_link", Reading(), **options), CONSOLE)
    return np.hypot(*(np.array([[row["x"], row["y"]] for row in rows]) - truth(STAMPS)[:, :2]).T)


def test_localisation(tmp_path):
    out, _ = imported(make(tmp_path, "ros1"), world="corridor")
    for file, world in ((out, ""), (tmp_path / "drive.bag", "corridor")):
        assert position_errors(file, world).max() < 0.02


@pytest.mark.parametrize("name", ["npz", "mcap"])
def test_laser_frame(tmp_path, name):
    file = make(tmp_path, name)
    scans = read_scans(imported(file, laser=True)[0])
    assert not scans.geometry.mount.any()
    # An .npz's poses are taken to be the laser's as they stand.
    wanted = odom(STAMPS) if name == "npz" else se2.compose(odom(STAMPS), MOUNT)
    np.testing.assert_allclose(scans.odom, wanted, atol=1e-6)


def test_upside_down_scanner(tmp_path):
    file = npz(tmp_path, ranges=ranges()[:, ::-1])
    scans = read_scans(imported(file, reading=Reading(mount=MOUNT, upside_down=True))[0])
    np.testing.assert_allclose(scans.ranges, ranges(), rtol=1e-6)
    np.testing.assert_allclose(scans.geometry.angles, ANGLES, atol=1e-6)


def test_log_without_stamps(tmp_path):
    file = npz(tmp_path, stamps=None)
    with pytest.raises(UserError, match="with rate in section log"):
        imported(file)
    np.testing.assert_allclose(read_scans(imported(file, rate=5.0)[0]).stamps, np.arange(SCANS) / 5)


def test_partial_reference(tmp_path):
    reference = truth(STAMPS)
    reference[4:6] = np.nan
    file = npz(tmp_path, reference=reference)
    assert imported(file)[1]["reference_poses"] == SCANS - 2
    assert imported(file, "without.mcap", reading=Reading(reference=False))[1]["reference_poses"] == 0


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"angles": ANGLES**3 / 4}, "not evenly spaced"),
        ({"angles": np.rad2deg(ANGLES)}, "more than one turn: are they in degrees"),
        ({"stamps": STAMPS * 1e-9 - 2e9}, "below 0 s"),
        ({"stamps": np.zeros(SCANS)}, "too few usable scans: 1; left out: scans twice: 11"),
    ],
)
def test_refusals_leave_no_file(tmp_path, changes, why):
    with pytest.raises(UserError, match=why):
        imported(npz(tmp_path, **changes))
    assert [path.name for path in tmp_path.iterdir()] == ["drive.npz"]


def test_names_of_files(tmp_path):
    file = npz(tmp_path)
    (tmp_path / "there.mcap").write_bytes(b"")
    for out, why in (("out.bag", "must end with .mcap"), ("there.mcap", "exists already; choose another name")):
        with pytest.raises(UserError, match=why):
            imported(file, out)
    with pytest.raises(UserError, match="no world"):
        imported(file, world="nowhere")


@pytest.mark.parametrize(
    ("section", "why"),
    [
        ("mount: '1'", "mount"),
        ("angles: '90'", "angles '90'"),
        ("angles: 90,-90", "to the left"),
        ("clock: wall", "clock"),
    ],
)
def test_invalid_log_settings(tmp_path, section, why):
    (tmp_path / "c.yaml").write_text(f"log:\n  {section}\n")
    with pytest.raises(UserError, match=why):
        load_section(LogSettings, tmp_path / "c.yaml", "log").reading()


def test_figure_without_poses(tmp_path):
    """Without poses there is but a world; warnings are errors."""
    out, _ = imported(make(tmp_path, "mcap"), world="corridor", reading=Reading(reference=False))
    draw_session(out, tmp_path / "drive.png")
    assert (tmp_path / "drive.png").stat().st_size > 10_000


def test_rplidar_of_a_full_turn(tmp_path):
    """The first direction is measured twice, in single precision a little more than a turn; beams come and go."""
    exact = load_world("corridor")

    def turn(k):
        beams = 360 + (k * 11) % 9 - 4 if k else 360
        first, last = np.float32(-np.pi), np.float32(np.pi)
        angles = np.linspace(first, last, beams)
        row = exact.ray_distances(se2.compose(truth(STAMPS[k]), MOUNT)[None], angles)[0]
        row[::7] = (0.0, np.inf)[k % 2]
        step = np.float32((last - first) / (beams - 1))
        return {"angle_min": first, "angle_max": last, "angle_increment": step, "ranges": row.astype(np.float32)}

    out, facts = imported(write_bag(tmp_path, Bag("ros1", each=turn, localised=True)), world="corridor")
    assert (facts["scans"], facts["left_out"]) == (SCANS, {})
    assert any("resampled at the angles of the first" in note for note in facts["notes"])
    assert read_recording(out).scanner().beams == 360
    assert position_errors(out, "").max() < 0.02
