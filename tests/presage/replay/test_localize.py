"""`presage localize` over .npz files and a recording."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from rich.console import Console

from common.bus.bus import wait_until
from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import CmdVel, Goal, Odom, Pose, Scan, Truth, Twist
from common.messages.topics import CMD_VEL, GOAL, ODOM, SCAN, TRUTH
from common.robot.scanner import SCANNERS
from presage.logs.importing import ImportOptions, import_command
from presage.logs.log import Reading
from presage.logs.scan_files import Scans, read_scans
from presage.replay.localize import COLUMNS, LocalizeOptions, build_estimator_options, localize, select_scans
from presage.replay.rerun import RerunOptions, rerun_command
from services.estimator.paper.perception import Descent
from services.estimator.shared.model_folder import SHIPPED
from services.recorder.files.writer import RecordingWriter
from tests.conftest import WAIT_TIMEOUT_S
from tests.recorder.sessions import write

SCANNER = SCANNERS["tim571"].with_beams(200)
WORLD = load_world("corridor")
PATH = np.column_stack([np.linspace(4, 4.6, 10), np.full(10, 1.5), np.linspace(1, 1.2, 10)])
CONSOLE = Console(quiet=True)
CORRIDOR = ("corridor-precise.json", "corridor-precise.safetensors")


def npz(folder: Path, mount=SCANNER.mount, **changes) -> Path:
    rng = np.random.default_rng(0)
    lasers = se2.compose(PATH, np.array(mount))
    ranges = WORLD.ray_distances(lasers, SCANNER.angles()) + 0.02 * rng.standard_normal((10, 200))
    values = {
        "ranges": ranges, "angles": SCANNER.angles(), "range_max": 25.0, "stamps": np.arange(10) / 15,
        "odom": PATH - PATH[0], "initial_pose": PATH[0],
    }  # fmt: skip
    values = {name: value for name, value in {**values, **changes}.items() if value is not None}
    file = folder / "scans.npz"
    np.savez(file, **values)
    return file


def job(file, mode="global", frame="base_link", estimator="precise", model="learned", world="corridor", **more):
    out = more.pop("out", None)
    models = more.pop("models", None)
    descent = more.pop("descent", Descent())
    estimator_options = build_estimator_options(
        file, world, estimator, model, models, 0.02, 0, more.pop("initial_pose", ""), descent
    )
    given = {"odometry": True, "out": out, **more}
    return LocalizeOptions.of(file, estimator_options, mode, frame, given.pop("reading", Reading()), **given)


def errors(rows, path=PATH):
    return np.hypot(*(np.array([[r["x"], r["y"]] for r in rows]) - path[:, :2]).T)


@pytest.mark.parametrize("mode", ["global", "single"])
@pytest.mark.parametrize("model", ["learned", "exact"])
def test_csv(tmp_path, capsys, mode, model):
    localize(job(npz(tmp_path), mode=mode, model=model), Console(stderr=True))
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))  # nothing else on standard output
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 10
    numbers = [{k: float(v) for k, v in row.items() if k != "state"} for row in rows]
    assert errors(numbers).max() < 0.02
    assert {row["state"] for row in rows} == {"tracking"}
    assert all(row["cov_xx"] > 0 and row["update_ms"] > 0 for row in numbers)


def test_json(tmp_path):
    out = tmp_path / "poses.json"
    rows = localize(job(npz(tmp_path), mode="single", out=out), CONSOLE)
    data = json.loads(out.read_text())
    assert {"world", "estimator", "model", "frame", "seed", "commit"} <= set(data)
    assert data["mode"] == "single"
    assert data["rows"] == rows


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_disk(tmp_path, monkeypatch):
    out = tmp_path / "out.csv"
    out.symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left") as error:
        localize(job(npz(tmp_path), out=out), CONSOLE)
    assert error.value.filename == str(out)
    out = tmp_path / "out.tum"
    monkeypatch.setattr(np, "savetxt", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left") as error:
        localize(job(npz(tmp_path), out=out), CONSOLE)
    assert error.value.filename == str(out)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out.csv", "scans.npz"]


def test_tum(tmp_path):
    out = tmp_path / "poses.tum"
    rows = localize(job(npz(tmp_path), out=out), CONSOLE)
    stamps, x, y, *_, sine, cosine = np.loadtxt(out).T
    poses = np.column_stack([stamps, x, y, 2 * np.arctan2(sine, cosine)])
    assert poses == pytest.approx(
        np.array([[row[name] for name in ("stamp", "x", "y", "yaw")] for row in rows]), abs=1e-8
    )


def test_laser_frame(tmp_path):
    file = npz(tmp_path, mount=(0, 0, 0))  # PATH is the laser's
    assert errors(localize(job(file, frame="laser"), CONSOLE)).max() < 0.02
    assert errors(localize(job(file, frame="base_link"), CONSOLE)).min() > 0.15


def test_assumed_mount_must_fit_weights(tmp_path):
    """A forgotten --mount would put every pose off by 0.2 m."""
    folder = shutil.copytree(SHIPPED, tmp_path / "models", ignore=lambda _, names: set(names) - set(CORRIDOR))
    card = json.loads((folder / CORRIDOR[0]).read_text())
    card["scanner"]["mount"] = [0.0, 0.0, 0.0]
    (folder / CORRIDOR[0]).write_text(json.dumps(card))
    file = npz(tmp_path, mount=(0, 0, 0))
    with pytest.raises(UserError, match=r"0.2,0,0 was assumed, but .* trained with 0,0,0; give --mount"):
        localize(job(file, models=folder), CONSOLE)
    stated = Reading(mount=np.zeros(3))
    assert errors(localize(job(file, models=folder, reading=stated), CONSOLE)).max() < 0.02
    out = tmp_path / "imported.mcap"
    import_command(ImportOptions(file, out, world="corridor"), None, CONSOLE, CONSOLE)
    again = {"models": str(folder), "model": "learned"}
    with pytest.raises(UserError, match="import its log again with --mount"):
        localize(job(out, models=folder), CONSOLE)
    with pytest.raises(UserError, match="import its log again with --mount"):
        rerun_command(RerunOptions(out, again), None, CONSOLE)
    elsewhere = Reading(mount=np.array([0.2, 0, 0]))  # a field serves a laser mounted anywhere
    assert errors(localize(job(npz(tmp_path), models=folder, reading=elsewhere), CONSOLE)).max() < 0.02


def test_start_pose(tmp_path):
    file = npz(tmp_path, stamps=None, odom=None, initial_pose=None)
    assert errors(localize(job(file), CONSOLE)).max() < 0.02
    with pytest.raises(UserError, match="mode track needs the pose of the first scan"):
        localize(job(file, mode="track"), CONSOLE)
    assert errors(localize(job(file, mode="track", initial_pose="4,1.5,57"), CONSOLE)).max() < 0.02


def test_reference(tmp_path, capsys):
    reference = PATH.copy()
    reference[5:] = np.nan  # not known throughout
    frame = np.array([3.0, -2.0, 3.0])  # of the reference, in map
    file = npz(tmp_path, mount=(0, 0, 0), reference=reference, initial_pose=None)
    np.testing.assert_array_equal(read_scans(file, np.zeros(3)).truth, reference)
    rows = localize(job(file, mode="track", frame="laser"), Console(width=150))
    assert errors(rows).max() < 0.02
    assert "against the file's reference: " in capsys.readouterr().out
    turned = npz(tmp_path, mount=(0, 0, 0), reference=se2.between(frame, reference), initial_pose=None)
    localize(job(turned, mode="track", frame="laser", initial_pose="4,1.5,57"), Console(width=150))
    far, fitted = re.findall(r"([\d.]+) mm maximum", capsys.readouterr().out)
    assert float(far) > 1000
    assert float(fitted) < 20


@pytest.mark.parametrize("estimator", ["particle-filter", "amcl-defaults"])
def test_particle_filter(tmp_path, estimator):
    rows = localize(job(npz(tmp_path), mode="track", estimator=estimator), CONSOLE)
    assert errors(rows).max() < 0.5


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"ranges": None}, "lacks ranges"),
        ({"angles": np.zeros(3)}, "angles has the shape"),
        ({"odom": np.zeros((3, 3))}, "odom has the shape"),
        ({"reference": np.zeros((9, 3))}, "reference has the shape"),
        ({"stamps": -np.arange(10.0)}, "too few usable scans: 1; left out: scans older than the one before: 9"),
        ({"range_max": -1.0}, "range_max"),
        ({"initial_pose": np.full(3, np.nan)}, "not finite"),
        ({"ranges": np.zeros((2, 3, 4))}, "not \\(N, B\\)"),
    ],
)
def test_wrong_arrays(tmp_path, changes, why):
    with pytest.raises(UserError, match=rf"scans.npz.*{why}"):
        read_scans(npz(tmp_path, **changes))


def test_wrong_files(tmp_path):
    pickled, foreign = tmp_path / "p.npz", tmp_path / "x.npz.txt"
    np.savez(pickled, ranges=np.array([{}], dtype=object), angles=np.zeros(3), range_max=1.0)
    foreign.write_text("ranges, angles\n")
    for file, why in ((pickled, "plain arrays"), (foreign, "not a presage recording, a CARMEN log")):
        with pytest.raises(UserError, match=why):
            read_scans(file)


def test_stamps_and_ranges_of_an_npz(tmp_path):
    stamps = [1000.0, 1000.1, 1600000000.3]
    row = [1.0, 25.0, np.inf, 0.0, np.nan, -np.inf]
    np.savez(tmp_path / "s.npz", stamps=stamps, ranges=[row] * 3, angles=np.arange(6) / 10, range_max=25.0)
    scans = read_scans(tmp_path / "s.npz")
    assert scans.stamps.tolist() == [scan.stamp for scan in scans] == stamps
    assert scans[0].ranges.tolist() == [1.0, np.inf, np.inf, -np.inf, -np.inf, -np.inf]


def test_stamps_of_an_npz_that_step_back(tmp_path):
    stamps = [0.0, 0.1, 0.2, 0.1, 0.2, 0.3]
    np.savez(tmp_path / "s.npz", stamps=stamps, ranges=np.ones((6, 3)), angles=np.arange(3) / 10, range_max=25.0)
    scans = read_scans(tmp_path / "s.npz")
    assert scans.stamps.tolist() == [0.0, 0.1, 0.2, 0.3]
    assert "left out: scans older than the one before: 1, scans twice: 1" in scans.notes


def test_unknown_odometry_in_an_npz(tmp_path):
    odom = PATH - PATH[0]
    odom[:2] = np.nan
    np.testing.assert_array_equal(read_scans(npz(tmp_path, odom=odom)).odom, odom)


def test_late_odometry_in_a_recording(tmp_path):
    """One message that comes late leaves the others where they were."""
    writer = RecordingWriter(tmp_path / "r.mcap")
    scan = Scan(stamp_ns=0, angle_min=0.0, angle_increment=0.1, range_min=0.0, range_max=9.0, ranges=np.ones(4))
    for number, stamp in enumerate([0, 1, 3, 2, 4, 5]):
        odom = Odom(stamp_ns=stamp, pose=Pose(x=float(stamp), y=0.0), twist=Twist(), covariance=np.eye(3))
        for topic, message in ((ODOM, odom), (SCAN, scan.model_copy(update={"stamp_ns": number}))):
            writer.write(topic, topic.key("robot"), message.encode(), 10 * number, 10 * number)
    assert read_scans(writer.finish()).odom[:, 0].tolist() == [0, 1, 2, 3, 4, 5]


def plain(rows):
    return [{name: value for name, value in row.items() if name != "update_ms"} for row in rows]


@pytest.mark.parametrize("estimator", ["precise", "particle-filter"])
def test_selected_scans(tmp_path, estimator):
    whole, stamps = npz(tmp_path), 1.6e9 + np.arange(10) / 10
    data = dict(np.load(whole))
    chosen = slice(2, 9, 3)  # between 0.2 and 0.8 s each third scan: 2, 5, 8
    np.savez(whole, **{**data, "stamps": stamps, "reference": PATH})
    few = {name: data[name][chosen] for name in ("ranges", "odom")}
    part = tmp_path / "part.npz"
    np.savez(part, **{**data, **few, "stamps": stamps[chosen], "reference": PATH[chosen], "initial_pose": PATH[2]})
    given = {"mode": "track", "estimator": estimator, "start": 0.2, "end": 0.8, "every": 3}
    rows = localize(job(whole, **given), CONSOLE)
    assert [row["stamp"] for row in rows] == stamps[chosen].tolist()
    assert plain(rows) == plain(localize(job(part, mode="track", estimator=estimator), CONSOLE))
    rows = localize(job(whole, **{**given, "end": -0.1}), CONSOLE)
    assert [row["stamp"] for row in rows] == stamps[chosen].tolist()


def test_summary_of_selected_scans(tmp_path, capsys):
    reference = np.column_stack([PATH[:, :2] + np.arange(10)[:, None], PATH[:, 2]])  # 0 m off at the first, then more
    out = tmp_path / "poses.json"
    file = npz(tmp_path, reference=reference)
    rows = localize(job(file, start=0.1, every=4, out=out), Console(width=150))  # scans 2 and 6
    output = capsys.readouterr().out
    assert "2 of 10 scans: 2 tracking" in output
    middle, most = (float(output.split("reference: ")[1].split(",")[k].split()[0]) for k in (0, 2))
    assert [middle, most] == pytest.approx([4e3 * 2**0.5, 6e3 * 2**0.5], abs=20)  # mm
    data = json.loads(out.read_text())
    assert data["rows"] == rows
    assert (data["start"], data["end"], data["every"], data["complete"]) == (0.1, None, 4, True)


def test_scans_that_do_not_fit_the_map(tmp_path, capsys):
    far = np.tile(np.linspace(1.0, 2.0, 200), (10, 1))  # a spiral
    for ranges, hint in ((far, True), (None, False)):
        file = npz(tmp_path, ranges=ranges) if ranges is not None else npz(tmp_path)
        localize(job(file, out=tmp_path / "poses.csv"), Console(width=150))
        assert ("is this the right map?" in capsys.readouterr().out) is hint


def test_selection_refusals(tmp_path):
    file = npz(tmp_path)
    scans, unstamped = read_scans(file), replace(read_scans(file), stamps=None)
    for wrong, why in (
        ({"start": 2.0}, "--start 2: the recording lasts 0.60 s"),
        ({"start": 0.4, "end": 0.2}, "nothing lies between"),
        ({"start": 0.21, "end": 0.25}, r"scans.npz: no scan between 0.21 and 0.25 s"),
    ):
        with pytest.raises(UserError, match=why):
            select_scans(job(file, **wrong), scans)
    for wrong in ({"start": 0.2}, {"end": 0.2}, {"every": 2}):
        with pytest.raises(UserError, match="no stamps, which --start, --end and --every need"):
            select_scans(job(file, **wrong), unstamped)
    with pytest.raises(UserError, match="mode track needs the pose of the first scan"):  # initial_pose is of scan 0
        localize(job(file, start=0.2, mode="track"), CONSOLE)


@pytest.mark.parametrize("suffix", ["csv", "json", "tum"])
def test_interrupted_run_keeps_rows(tmp_path, capsys, monkeypatch, suffix):
    file, out, given = npz(tmp_path), tmp_path / f"poses.{suffix}", Scans.__getitem__

    def interrupted_at_the_fifth(scans, k):
        if k < 4:
            return given(scans, k)
        if suffix == "csv":  # also of a run that is killed
            assert len(out.read_text().splitlines()) == 1 + 4
        raise KeyboardInterrupt

    monkeypatch.setattr(Scans, "__getitem__", interrupted_at_the_fifth)
    with pytest.raises(KeyboardInterrupt):
        localize(job(file, out=out), Console(width=500))
    last = capsys.readouterr().out.splitlines()[-2:]
    assert last[0].startswith("4 of 10 scans: 4 tracking")
    assert last[1] == f"interrupted after 4 of 10 scans; their rows are in {out}"
    if suffix == "json":
        data = json.loads(out.read_text())
        assert not data["complete"]
        assert len(data["rows"]) == 4
        return
    if suffix == "tum":
        assert len(np.loadtxt(out)) == 4
        return
    with out.open() as stream:
        assert len([float(row["update_ms"]) for row in csv.DictReader(stream)]) == 4


def test_ctrl_c_ends_with_status_130(tmp_path, processes):
    data = dict(np.load(npz(tmp_path)))
    many = {name: np.tile(data[name], (300, 1)) for name in ("ranges", "odom")}
    np.savez(tmp_path / "long.npz", **{**data, **many, "stamps": np.arange(3000) / 10})
    out = tmp_path / "poses.csv"
    arguments = ["localize", str(tmp_path / "long.npz"), "--world", "corridor", "--mode", "single", "--out", str(out)]
    running = processes.start("presage.__main__", *arguments)
    assert wait_until(lambda: out.exists() and len(out.read_text().splitlines()) > 3, 4 * WAIT_TIMEOUT_S)
    assert running.stop(signal.SIGINT) == 130
    last = running.output.splitlines()[-1]
    assert last.endswith(f" of 3000 scans; their rows are in {out}")
    assert len(out.read_text().splitlines()) == int(last.split()[2]) + 1


def test_option_refusals(tmp_path):
    file = npz(tmp_path)
    for wrong, why in (
        ({"mode": "best"}, "no mode"), ({"frame": "map"}, "no frame"), ({"estimator": "kalman"}, "no estimator"),
        ({"world": ""}, "--world"), ({"model": "best"}, "no model"), ({"initial_pose": "1"}, "initial-pose"),
        ({"initial_pose": "4,1.5"}, "add --mode track"),
        ({"initial_pose": "400,1.5", "mode": "track"}, r"\(400, 1.5\) is off the map: .* goes from"),
        ({"out": tmp_path / "x.txt"}, ".csv, .json or .tum"), ({"out": tmp_path / "no" / "x.csv"}, "cannot be written"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=why):
            localize(job(file, **wrong), CONSOLE)


def test_recording(tmp_path):
    file = write(tmp_path / "run.mcap")
    scans = read_scans(file)
    assert len(scans.stamps) == len(scans) == len(scans.truth)
    rows = localize(job(file, world="", model="exact"), CONSOLE)
    assert errors(rows, scans.truth).max() < 0.03
    with pytest.raises(UserError, match="leave out the options for logs"):
        localize(job(file, world="", model="exact", reading=Reading(mount=np.zeros(3))), CONSOLE)
    with pytest.raises(UserError, match="presage train --world hall"):  # there are no weights for that world
        localize(job(file, world=""), CONSOLE)


def test_recording_of_a_restarted_simulation(tmp_path):
    """Stamps begin again; truth, odometry, command and goal are those at the scan."""
    writer = RecordingWriter(tmp_path / "r.mcap")
    pose, scan = Pose(x=0.0, y=0.0), Scan(
        stamp_ns=0, angle_min=0.0, angle_increment=0.1, range_min=0.0, range_max=9.0, ranges=np.ones(4)
    )  # fmt: skip
    for number in range(4):  # stamps 0, 1, 0, 1
        stamp, x = number % 2, float(number)
        command = CmdVel(stamp_ns=stamp, twist=Twist(vx=x))
        goal = Goal(stamp_ns=stamp, pose=pose.model_copy(update={"x": x}), cancel=number == 3)
        truth = Truth(stamp_ns=stamp, pose=goal.pose, twist=Twist())
        odom = Odom(stamp_ns=stamp, pose=goal.pose, twist=Twist(), covariance=np.eye(3))
        messages = (CMD_VEL, command), (GOAL, goal), (SCAN, scan.model_copy(update={"stamp_ns": stamp}))
        for topic, message in (*messages, (SCAN, messages[2][1]), (TRUTH, truth), (ODOM, odom)):
            writer.write(topic, topic.key("robot"), message.encode(), 10 * number, 10 * number)
    scans = read_scans(writer.finish())
    assert scans.stamps_ns.tolist() == [0, 1, 0, 1]
    for column in (scans.truth, scans.odom, scans.commands):
        assert column[:, 0].tolist() == [0, 1, 2, 3]
    assert scans[2].goal[0] == 2
    assert scans[3].goal is None
    priors = {prior: scans.with_prior(prior)[1] for prior in ("motion", "odometry", "command")}
    given = {prior: (scan.odom is not None, scan.command is not None) for prior, scan in priors.items()}
    assert given == {"motion": (False, False), "odometry": (True, False), "command": (False, True)}


def paper_output(file, **more):
    """What `presage localize` prints with preset paper, which knows only a heading of 90 deg."""
    console = Console(file=io.StringIO(), width=200)
    localize(job(file, estimator="paper", out=file.parent / "poses.csv", **more), console)
    return console.file.getvalue()


def turning_drive(**columns):
    """Scans of a robot that turns from 90 to 117 deg; only the poses matter here."""
    yaws = np.deg2rad(np.arange(90.0, 120.0, 3.0))
    return {name: np.column_stack([PATH[:, :2], yaws + shift]) for name, shift in columns.items()}


@pytest.mark.parametrize(
    ("poses", "expected"),
    [
        (turning_drive(reference=0.0), "according to the file's reference the robot has another in 9 of 10 scans"),
        (turning_drive(odom=-1.0), "according to the odometry the robot has another in 9 of 10 scans"),
    ],
    ids=["reference", "odometry"],
)
def test_other_heading_than_that_of_preset_paper(tmp_path, poses, expected):
    text = paper_output(npz(tmp_path, **{"odom": None, **poses}))
    assert f"warning: preset paper assumes a heading of 90 deg, but {expected}" in text


def test_heading_of_preset_paper(tmp_path):
    upright = np.column_stack([PATH[:, :2], np.full(10, np.pi / 2)])
    assert "heading" not in paper_output(npz(tmp_path, odom=upright, reference=upright))


def test_parameters_of_preset_paper(tmp_path):
    """Section `estimator` of the settings file sets them."""
    still = job(npz(tmp_path), estimator="paper", descent=Descent(alpha=1e-9, iterations=1))
    rows = localize(replace(still, out=tmp_path / "still.csv"), CONSOLE)
    assert np.ptp([row["x"] for row in rows]) < 1e-3
