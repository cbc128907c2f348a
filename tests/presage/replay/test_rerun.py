"""`presage rerun`: a copy of a recording with new beliefs, and what it takes from the recording."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.messages.definitions import Belief, Pose
from common.messages.topics import BELIEF, PREDICTION, SCAN, TRUTH
from presage.recordings.selection import robot_of
from presage.replay import rerun as shell
from presage.replay.estimator_comparison import BeliefSeries, compare
from presage.replay.recorded_settings import estimator_settings, recorded_settings, settings_with
from presage.replay.rerun import RerunOptions, rerun_command, unused_robot_name
from services.estimator.settings import EstimatorSettings
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import read_recording
from tests.conftest import ROOT
from tests.recorder import sessions as made

EXACT = {"estimator": "precise", "model": "exact"}
SHIPPED = ROOT / "models" / "corridor-precise.safetensors"


def quiet():
    return Console(file=io.StringIO(), width=150)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return made.write(tmp_path_factory.mktemp("made") / "run.mcap")


@pytest.fixture(scope="module")
def run(session):
    """The session with the exact model: new file, printed text, numbers."""
    out, numbers, console = session.with_name("new.mcap"), session.with_name("new.json"), quiet()
    rerun_command(RerunOptions(session, EXACT, out), numbers, console)
    return out, console.file.getvalue(), json.loads(numbers.read_text())


def test_copy_contains_every_old_byte(session, run):
    old, new = read_recording(session), read_recording(run[0])
    assert [raw for raw in new.payloads() if raw.key.split("/")[1] == "robot"] == list(old.payloads())
    assert new.attachments == old.attachments
    assert {name: values for name, values in new.metadata.items() if name != "rerun:robot-rerun"} == old.metadata
    assert json.loads(new.metadata["rerun:robot-rerun"]["config"])["model"] == "exact"
    assert (robot_of(new), unused_robot_name(new, "robot")) == ("robot", "robot-rerun2")


def test_new_beliefs_follow_the_old(run):
    new = read_recording(run[0])
    counts = {key: count for key, count in new.counts.items() if key.startswith("presage/robot-rerun/")}
    assert counts == {BELIEF.key("robot-rerun"): made.SCANS, PREDICTION.key("robot-rerun"): made.SCANS}
    beliefs = [(raw.key, Belief.decode(raw.payload).stamp_ns) for raw in new.payloads() if raw.key.endswith("/belief")]
    stamps = [i * made.PERIOD_NS for i in range(made.SCANS)]
    assert beliefs == [(BELIEF.key(robot), stamp) for stamp in stamps for robot in ("robot", "robot-rerun")]


def test_numbers_follow_from_the_file(run):
    new, numbers = read_recording(run[0]), run[2]
    truths = {m.stamp_ns: m.pose.array() for _, m, _ in new.messages(TRUTH)}
    errors, nees = {"robot": [], "robot-rerun": []}, []
    for _, message, raw in new.messages(BELIEF):
        off = message.pose.array() - truths[message.stamp_ns]
        off[2] = se2.wrap(off[2])
        if message.state == "tracking":
            errors[raw.key.split("/")[1]].append(np.hypot(*off[:2]))
            if message.covariance is not None:
                nees.append(off @ np.linalg.inv(message.covariance) @ off)
    for part, robot in (("recorded", "robot"), ("new", "robot-rerun")):
        assert numbers[part]["position_error_median_m"] == pytest.approx(np.median(errors[robot]))
        assert numbers[part]["position_error_max_m"] == pytest.approx(np.max(errors[robot]))
        assert numbers[part]["share_tracking"] == pytest.approx(len(errors[robot]) / made.SCANS)
    assert numbers["new"]["nees_mean"] == pytest.approx(np.mean(nees), rel=1e-6)
    assert numbers["recorded"]["nees_mean"] is None
    assert numbers["recorded"]["position_error_max_m"] == pytest.approx(0.2)  # as the session was made
    assert numbers["new"]["position_error_median_m"] < 0.02
    assert numbers["scans_compared"] == made.SCANS


def test_table_and_figure(run):
    out, text, _ = run
    assert "200 mm" in text
    assert "NEES" in text
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert out.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
    with out.with_suffix(".csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == made.SCANS
    assert max(float(row["recorded_error_m"]) for row in rows) == pytest.approx(2.0)


def test_interrupted_run_leaves_no_file(session, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(shell, "belief_message", interrupted)
    with pytest.raises(KeyboardInterrupt):
        rerun_command(RerunOptions(session, EXACT, session.with_name("never.mcap")), None, quiet())
    assert not list(session.parent.glob("never*"))


def test_missing_weights_name_no_temporary_file(session):
    """The command that trains them is also right when the run has ended."""
    why = r"presage train --world hall\.yaml .*run\.mcap contains as attachment world"
    for preset in ("paper", "precise"):
        with pytest.raises(UserError, match=why) as error:
            rerun_command(RerunOptions(session, {"estimator": preset}, session.with_name("never.mcap")), None, quiet())
        assert "presage-" not in str(error.value)


def test_settings_that_differ_are_named(tmp_path):
    console, config = quiet(), json.dumps({**EXACT, "world": "hall", "sigma": 0.02})
    recording = made.write(tmp_path / "config.mcap", metadata={"config:estimator": {"config": config}})
    options = RerunOptions(recording, {"sigma": 0.05, "alpha": 0.1}, tmp_path / "out.mcap")
    rerun_command(options, None, console)
    text = console.file.getvalue()
    assert "new: precise, sigma 0.05" in text
    assert "warning: alpha applies only to preset paper; ignored" in text


def test_refusals(session, tmp_path, run):
    without_scans = made.write(tmp_path / "blind.mcap", SCAN)
    without_world = made.write(tmp_path / "lost.mcap", world=False)
    for file, chosen, out, why in (
        (session, EXACT, run[0], r"new\.mcap: exists already; choose another name with --out"),
        (session, EXACT, tmp_path / "new.bag", r"must end with \.mcap"),
        (session, {**EXACT, "sigma": -1}, None, "setting of the estimator: sigma"),
        (without_scans, EXACT, None, r"blind\.mcap: no scan in it"),
        (without_world, EXACT, None, "no world was recorded: give one with --world"),
    ):
        with pytest.raises(UserError, match=why):
            rerun_command(RerunOptions(file, chosen, out), None, quiet())


def with_settings(path, *, weights=True, card=None, file="corridor-precise.safetensors", digest=True, **values):
    """A recording of an estimator's settings, world and weights."""
    writer = RecordingWriter(path)
    config = {"estimator": "precise", "world": "corridor", "robot": "r", "connect": "tcp/x", **values}
    writer.metadata("config:estimator", {"config": json.dumps(config)})
    model = {"estimator": "precise", "card": card or SHIPPED.with_suffix(".json").read_text(), "file": file}
    if digest:
        model["sha256"] = hashlib.sha256(SHIPPED.read_bytes()).hexdigest()
    writer.metadata("model", model)
    writer.attachment("world.yaml", b"name: the session's", "application/yaml", 0)
    writer.attachment("model/world.yaml", b"name: the estimator's", "application/yaml", 0)
    if weights:
        writer.attachment(f"model/{file}", SHIPPED.read_bytes(), "application/octet-stream", 0)
    return read_recording(writer.finish())


def settings_from(recording, folder):
    return estimator_settings(recording, folder, recorded_settings(recording, "estimator").values).values


def test_recorded_world_and_weights(tmp_path):
    recording = with_settings(tmp_path / "r.mcap", models="/somewhere/else", sigma=0.03, telepathy=True)
    values = settings_from(recording, tmp_path)
    assert values["sigma"] == 0.03
    assert not {"robot", "connect", "telepathy"} & values.keys()
    assert "does not know: telepathy" in recorded_settings(recording, "estimator").notes[0]
    assert recorded_settings(recording, "controller") is None
    assert Path(values["world"]).read_bytes() == b"name: the estimator's"
    unpacked = Path(values["models"]) / SHIPPED.name
    assert tmp_path in unpacked.parents
    for path in (unpacked, unpacked.with_suffix(".json")):
        assert path.read_bytes() == (SHIPPED.parent / path.name).read_bytes()


def test_weights_outside_the_recording(tmp_path):
    same = with_settings(tmp_path / "r.mcap", weights=False)
    assert settings_from(same, tmp_path)["models"] == str(SHIPPED.parent)
    card = json.dumps({**json.loads(SHIPPED.with_suffix(".json").read_text()), "seed": 99})
    with pytest.raises(UserError, match=r"corridor-precise\.safetensors are not in it, and none here are the recorded"):
        settings_from(with_settings(tmp_path / "o.mcap", weights=False, card=card, digest=False), tmp_path)
    damaged = with_settings(tmp_path / "d.mcap")
    damaged.attachments["model/corridor-precise.safetensors"] += b"x"
    with pytest.raises(UserError, match="their digest differs from the recorded one"):
        settings_from(damaged, tmp_path)
    unlearned = with_settings(tmp_path / "p.mcap", weights=False, card="{}", estimator="particle-filter")
    assert settings_from(unlearned, tmp_path)["estimator"] == "particle-filter"


@pytest.mark.parametrize("file", ["../evil.safetensors", "/etc/evil.safetensors", ".safetensors", "model.pt"])
def test_path_as_name_of_weights(tmp_path, file):
    with pytest.raises(UserError, match="which is not a file name"):
        settings_from(with_settings(tmp_path / "r.mcap", file=file), tmp_path)
    assert not list(tmp_path.rglob("*evil*"))


def test_settings_ignore_the_environment(monkeypatch):
    monkeypatch.setenv("PRESAGE_SIGMA", "0.5")
    settings = settings_with(EstimatorSettings, {"seed": 3})
    assert (settings.sigma, settings.seed) == (None, 3)


def series(*stamps_and_x):
    """Beliefs while tracking, with their stamps and x."""
    found = BeliefSeries("new")
    for stamp, x in stamps_and_x:
        pose = Pose(x=x, y=0.0, yaw=np.pi)
        found.add(Belief(stamp_ns=stamp, state="tracking", pose=pose, covariance=np.eye(3) / 100), 1.0)
    return found


def test_comparison_of_repeated_stamps():
    truth = np.array([[1.0, 0, np.pi], [5.0, 0, -np.pi + 0.01]])  # the simulation was restarted
    numbers = compare(series((7, 1.1), (7, 5.1)), series((7, 1.2), (7, 5.2)), truth).as_dict()
    assert numbers["scans_compared"] == 2
    assert numbers["recorded"]["position_error_max_m"] == pytest.approx(0.1)
    assert numbers["recorded"]["heading_error_median_rad"] == pytest.approx(0.005)
    assert numbers["new"]["nees_mean"] == pytest.approx(0.2**2 / 0.01 + 0.5 * 0.01**2 / 0.01)
    assert numbers["difference"]["position_max_m"] == pytest.approx(0.1)


def test_comparison_of_answered_scans():
    new = series(*((stamp, 1.0 if stamp < 5 else 0.5) for stamp in range(10)))
    numbers = compare(series(*((stamp, 0.0) for stamp in range(5, 10))), new, np.tile([0, 0, np.pi], (10, 1))).as_dict()
    assert numbers["scans_answered"] == {"recorded": 5, "new": 10}
    assert numbers["new"]["position_error_max_m"] == 0.5
    assert compare(BeliefSeries(), new, None).as_dict()["new"]["position_error_max_m"] is None
