"""CSV and TUM: what stands in the files is what was recorded."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
from unittest.mock import Mock

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.messages.definitions import Pose, Truth, Twist
from common.messages.topics import BELIEF, HEALTH, ODOM, SCAN, TOPICS, TRUTH
from presage.recordings import csv_tables
from presage.recordings.csv_tables import columns_of, export_csv
from presage.recordings.export import ExportOptions, run_export
from presage.recordings.tum import export_tum
from services.recorder.reader import read_recording
from tests.presage.recordings import artificial_session as driven

QUIET = Console(quiet=True)


def tables(tmp_path, *, arrays=False, **how):
    recording = driven.write(tmp_path / "run.mcap", **how)
    rows = export_csv(read_recording(recording), tmp_path / "csv", "", QUIET, arrays=arrays, force=False)
    return tmp_path / "csv", rows


def rows_of(path):
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_rows_of_scalars(tmp_path):
    folder, _ = tables(tmp_path)
    rows = rows_of(folder / "belief.csv")
    assert len(rows) == driven.STEPS
    row = rows[7]
    assert (row["stamp_ns"], row["seq"], row["state"]) == (str(7 * driven.PERIOD_NS), "7", "tracking")
    assert int(row["log_time_ns"]) == driven.BEGAN_NS + 7 * driven.PERIOD_NS + driven.BELIEVED_NS
    assert [float(row[f"pose.{axis}"]) for axis in ("x", "y", "yaw")] == driven.believed(7).tolist()  # to the last bit
    assert [float(row[f"covariance.{end}"]) for end in ("x_x", "x_y", "y_y", "yaw_yaw")] == [0.04, 0.0, 0.01, 0.0025]
    assert [float(row[f"xi.{axis}"]) for axis in ("x", "y", "yaw")] == [1.0, 2.0, 3.0]
    assert row["curvature.x_x"] == ""  # not stated
    assert rows_of(folder / "truth.csv")[5]["contact"] == "true"
    assert rows_of(folder / "status.csv")[0]["goal.x"] == ""
    assert rows_of(folder / "scan.csv")[0]["mount.x"] == "0.2"


def test_tables_of_lists_and_maps(tmp_path):
    folder, rows = tables(tmp_path)
    hypotheses = rows_of(folder / "belief.hypotheses.csv")
    assert len(hypotheses) == 2 * driven.STEPS
    assert [row["weight"] for row in hypotheses[:2]] == ["0.75", "0.25"]
    assert [row["index"] for row in hypotheses[:2]] == ["0", "1"]
    assert hypotheses[1]["covariance.x_x"] == ""
    (first, _) = rows_of(folder / "health.topics.csv")
    assert (first["key"], first["dropped"]) == (SCAN.key("rob"), "2")
    assert [(row["name"], row["value"]) for row in rows_of(folder / "health.counters.csv")] == [
        ("steps", "1"), ("steps", "11"),
    ]  # fmt: skip
    assert rows["belief.hypotheses.csv"] == 2 * driven.STEPS
    assert not list(folder.glob("*ranges*"))  # not asked for


def test_arrays(tmp_path):
    folder, _ = tables(tmp_path, arrays=True)
    rows = rows_of(folder / "scan.ranges-4.csv")
    assert [rows[2][str(n)] for n in range(4)] == ["1.0", "inf", "-inf", "2.5"]
    assert rows[2]["stamp_ns"] == str(2 * driven.PERIOD_NS)
    assert len(rows_of(folder / "prediction.sigma-4.csv")) == driven.STEPS
    assert "| `prediction.ranges-N.csv` | (B,) m" in (folder / "README.md").read_text()


def test_readme_explains_columns(tmp_path):
    folder, rows = tables(tmp_path)
    text = (folder / "README.md").read_text()
    for name in rows:
        header = (folder / name).read_text().splitlines()[0].split(",")
        assert all(
            f"`{column}`" in text or column in {"stamp_ns", "seq", "index", "name", "value"} for column in header
        )
    table_rows = [line for line in text.splitlines() if line.startswith("|")]
    assert all(len(re.split(r"(?<!\\)\|", row)) == 4 for row in table_rows)  # two cells
    assert "negative log-likelihood -ln p(o \\| pose)" in text
    assert "| `health.counters.csv`: `name`, `value` | numbers by name" in text
    assert "| `prediction.ranges-N.csv`, with `--arrays` | (B,) m" in text
    assert "which `presage export --format csv --arrays` writes" in text
    assert ".md" not in text
    assert "| `twist.vx` | m/s, forward; base_link |" in text
    assert "| `free_energy` | nats" in text


def test_full_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_tables, "_readme", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left") as error:
        tables(tmp_path)
    assert error.value.filename == str(tmp_path / "csv")
    assert list((tmp_path / "csv").iterdir()) == []


def test_more_files_than_may_be_open(tmp_path, monkeypatch):
    (tmp_path / "all").mkdir()
    expected, _ = tables(tmp_path / "all", arrays=True)
    monkeypatch.setattr(csv_tables, "MAX_OPEN_FILES", 2)
    folder, _ = tables(tmp_path, arrays=True)
    names = sorted(path.name for path in expected.iterdir())
    assert sorted(path.name for path in folder.iterdir()) == names
    assert [(folder / name).read_bytes() for name in names] == [(expected / name).read_bytes() for name in names]


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_columns_are_unique_and_explained(topic):
    columns = columns_of(topic.message)
    names = [column.name for column in columns]
    assert len(names) == len(set(names))
    assert {"stamp_ns", "seq"} <= set(names)
    unsaid = {c.name for c in columns if not c.meaning}
    assert unsaid <= {"frame_id", "state", "reason", "estimator", "service"}  # words


def test_undecodable_messages_are_counted(tmp_path, capsys):
    recording = driven.write(tmp_path / "run.mcap", also=[(TRUTH, TRUTH.key("rob"), b"\xc1", driven.BEGAN_NS)])
    run_export(ExportOptions(recording, "csv", tmp_path / "csv"), tmp_path / "out.json", QUIET)
    assert len(rows_of(tmp_path / "csv" / "truth.csv")) == driven.STEPS
    assert "1 messages could not be decoded" in capsys.readouterr().err
    numbers = json.loads((tmp_path / "out.json").read_text())
    assert (numbers["undecodable"], numbers["written"]["truth.csv"], numbers["complete"]) == (1, driven.STEPS, True)


def tum(tmp_path, *leave_out, localised_only=False, **how):
    recording = driven.write(tmp_path / "run.mcap", *leave_out, **how)
    rows = export_tum(
        read_recording(recording), tmp_path / "tum", "", QUIET, localised_only=localised_only, force=False
    )
    return tmp_path / "tum", rows


def test_tum_trajectories(tmp_path):
    folder, rows = tum(tmp_path)
    assert rows == {"truth.tum": driven.STEPS, "belief.tum": driven.STEPS, "odom.tum": driven.STEPS}
    for name, where in (("truth", driven.true), ("belief", driven.believed), ("odom", driven.odometry)):
        table = np.loadtxt(folder / f"{name}.tum")
        assert table.shape == (driven.STEPS, 8)
        assert table[:, 0] == pytest.approx(np.arange(driven.STEPS) * 0.1, abs=1e-12)
        poses = np.column_stack([table[:, 1:3], 2 * np.arctan2(table[:, 6], table[:, 7])])
        assert poses == pytest.approx(np.array([where(i) for i in range(driven.STEPS)]), abs=1e-8)
        assert not table[:, 3:6].any()


def test_tum_stamps_in_nanoseconds(tmp_path):
    stamp = 1_700_000_000_123_456_789
    late = Truth(stamp_ns=stamp, pose=Pose(x=0.0, y=0.0), twist=Twist()).encode()
    folder, _ = tum(tmp_path, also=[(TRUTH, TRUTH.key("rob"), late, driven.BEGAN_NS + 10**12)])
    assert (folder / "truth.tum").read_text().splitlines()[-1].startswith("1700000000.123456789 ")


def test_tum_after_a_restart(tmp_path):
    poses = [Truth(stamp_ns=stamp, pose=Pose(x=9.0, y=9.0), twist=Twist()) for stamp in (0, 0, 5)]  # one twice
    began = driven.BEGAN_NS + 10**11
    again = [(TRUTH, TRUTH.key("rob"), pose.encode(), began + number) for number, pose in enumerate(poses)]
    folder, rows = tum(tmp_path, also=again)
    assert rows["truth.tum"] == driven.STEPS
    assert rows["truth-2.tum"] == 2
    assert np.all(np.diff(np.loadtxt(folder / "truth-2.tum")[:, 0]) > 0)


def test_tum_of_tracked_beliefs(tmp_path):
    _, rows = tum(tmp_path, localised_only=True)
    assert rows["belief.tum"] == driven.STEPS - 3
    assert rows["truth.tum"] == driven.STEPS


@pytest.mark.skipif(shutil.which("evo_ape") is None, reason="evo is not installed")
def test_evo_finds_the_error(tmp_path):
    folder, _ = tum(tmp_path)
    run = ["evo_ape", "tum", "truth.tum", "belief.tum"]
    home = {**os.environ, "HOME": str(tmp_path)}  # it writes its settings there
    done = subprocess.run(run, cwd=folder, env=home, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "rmse\t0.050000" in done.stdout


def test_export_refusals(tmp_path):
    empty = read_recording(driven.write(tmp_path / "run.mcap", *TOPICS))
    with pytest.raises(UserError, match="nothing to export"):
        export_csv(empty, tmp_path / "csv", "", QUIET, arrays=False, force=False)
    with pytest.raises(UserError, match="no trajectory"):
        export_tum(empty, tmp_path / "tum", "", QUIET, localised_only=False, force=False)
    with pytest.raises(UserError, match="no format 'xml': choose csv, tum, foxglove"):
        run_export(ExportOptions(tmp_path / "run.mcap", "xml"), None, QUIET)


def test_folder_must_be_empty(tmp_path):
    recording = driven.write(tmp_path / "run.mcap")
    (tmp_path / "csv").mkdir()
    (tmp_path / "csv" / "mine.txt").touch()
    for job in (ExportOptions(recording, "csv", tmp_path / "csv"), ExportOptions(recording, "tum", tmp_path / "csv")):
        with pytest.raises(UserError, match=r"mine.txt: exists already; .* --force"):
            run_export(job, None, QUIET)
    assert [path.name for path in (tmp_path / "csv").iterdir()] == ["mine.txt"]
    run_export(ExportOptions(recording, "tum", tmp_path / "csv", force=True), None, QUIET)
    assert (tmp_path / "csv" / "belief.tum").exists()


def test_default_folder(tmp_path):
    active = driven.write(tmp_path / "run.mcap", BELIEF, ODOM, HEALTH, finish=False)
    run_export(ExportOptions(active, "tum"), None, QUIET)
    assert [path.name for path in (tmp_path / "run-tum").iterdir()] == ["truth.tum"]
