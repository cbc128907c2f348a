"""An estimator over a recording, offline: every old byte, the new beliefs beside them, numbers that can be redone."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.messages.definitions import Belief, CmdVel, Pose, Status, Truth, Twist
from common.messages.topics import BELIEF, PREDICTION, SCAN, TRUTH
from presage.recordings.selection import robot_of
from presage.replay import rerun as shell
from presage.replay.comparison import MessagePairs, ReplayOutcome
from presage.replay.goal_times import GoalTimes
from presage.replay.recorded_session import estimator_settings, recorded_settings
from presage.replay.report import BeliefSeries, ComparisonBuilder
from presage.replay.rerun import RerunOptions, rerun_command, unused_robot_name
from presage.replay.service_replay import describe
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import read_recording
from tests.recorder import sessions as made

EXACT = {"estimator": "precise", "model": "exact"}
SHIPPED = Path(shell.__file__).parents[2] / "models" / "corridor-precise.safetensors"


def belief(stamp, x=0.0, y=0.0, yaw=0.0, state="tracking", covariance=None, free_energy=1.0):
    return Belief(
        stamp_ns=stamp, state=state, pose=Pose(x=x, y=y, yaw=yaw), covariance=covariance, free_energy=free_energy,
        accuracy=1.0, xi=np.zeros(3, np.float32),
    )  # fmt: skip


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return made.write(tmp_path_factory.mktemp("made") / "run.mcap")


@pytest.fixture(scope="module")
def run(session):
    """The session with the exact model over it: file, printed text, numbers."""
    out, numbers, said = session.with_name("new.mcap"), session.with_name("new.json"), io.StringIO()
    rerun_command(RerunOptions(session, EXACT, out), numbers, Console(file=said, width=150))
    return out, said.getvalue(), json.loads(numbers.read_text())


def test_every_old_byte_is_in_the_new_recording(session, run):
    old, new = read_recording(session), read_recording(run[0])
    copied = [raw for raw in new.payloads() if raw.key.split("/")[1] == "robot"]
    assert copied == list(old.payloads())
    assert new.attachments == old.attachments
    assert {name: values for name, values in new.metadata.items() if name != "rerun:robot-rerun"} == old.metadata
    assert json.loads(new.metadata["rerun:robot-rerun"]["config"])["model"] == "exact"


def test_new_beliefs_and_predictions_are_another_robots(run):
    new = read_recording(run[0])
    mine = {key: count for key, count in new.counts().items() if key.startswith("presage/robot-rerun/")}
    assert mine == {BELIEF.key("robot-rerun"): made.SCANS, PREDICTION.key("robot-rerun"): made.SCANS}
    got = [(raw.key, Belief.decode(raw.payload).stamp_ns) for raw in new.payloads() if raw.key.endswith("/belief")]
    stamps = [i * made.PERIOD_NS for i in range(made.SCANS)]
    # Right behind the old one of its stamp.
    assert got == [(BELIEF.key(robot), stamp) for stamp in stamps for robot in ("robot", "robot-rerun")]
    assert robot_of(new) == "robot"


def test_the_numbers_can_be_redone_from_the_file(run):
    new, numbers = read_recording(run[0]), run[2]
    truths = {m.stamp_ns: m.pose.array() for _, m, _ in new.messages(TRUTH)}
    errors = {"robot": [], "robot-rerun": []}
    nees = []
    for _, message, raw in new.messages(BELIEF):
        away = message.pose.array() - truths[message.stamp_ns]
        away[2] = se2.wrap(away[2])
        if message.state == "tracking":
            errors[raw.key.split("/")[1]].append(np.hypot(*away[:2]))
            if message.covariance is not None:
                nees.append(away @ np.linalg.inv(message.covariance) @ away)
    for part, robot in (("recorded", "robot"), ("new", "robot-rerun")):
        assert numbers[part]["position_error_median_m"] == pytest.approx(np.median(errors[robot]))
        assert numbers[part]["position_error_max_m"] == pytest.approx(np.max(errors[robot]))
        assert numbers[part]["share_tracking"] == pytest.approx(len(errors[robot]) / made.SCANS)
    assert numbers["new"]["nees_mean"] == pytest.approx(np.mean(nees), rel=1e-6)
    assert numbers["recorded"]["nees_mean"] is None
    assert numbers["recorded"]["position_error_max_m"] == pytest.approx(0.2)  # as the session was made
    assert numbers["new"]["position_error_median_m"] < 0.02  # rays against the world they were cast in
    assert numbers["scans_compared"] == made.SCANS


def test_table_figure_and_data_are_written(run):
    out, said, numbers = run
    assert "200 mm" in said
    assert "NEES" in said
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert out.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
    with out.with_suffix(".csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == made.SCANS
    assert max(float(row["recorded_error_m"]) for row in rows) == pytest.approx(2.0)
    tracking = [float(row["new_error_m"]) for row in rows if float(row["new_tracking"])]
    assert np.median(tracking) == pytest.approx(numbers["new"]["position_error_median_m"])


def test_a_rerun_of_a_rerun_has_a_name_of_its_own(run):
    assert unused_robot_name(read_recording(run[0]), "robot") == "robot-rerun2"


def test_nothing_is_left_of_what_was_interrupted(session, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(shell.OfflineEstimatorService, "on_message", interrupted)
    out = session.with_name("never.mcap")
    with pytest.raises(KeyboardInterrupt):
        rerun_command(RerunOptions(session, EXACT, out), None, Console(file=io.StringIO()))
    assert not list(session.parent.glob("never*"))


def test_what_cannot_be_is_said(session, tmp_path, run):
    console = Console(file=io.StringIO())
    with pytest.raises(UserError, match=r"new\.mcap: exists already; choose another name with --out"):
        rerun_command(RerunOptions(session, EXACT, run[0]), None, console)
    with pytest.raises(UserError, match=r"must end with \.mcap"):
        rerun_command(RerunOptions(session, EXACT, tmp_path / "new.bag"), None, console)
    blind = made.write(tmp_path / "blind.mcap", SCAN)
    with pytest.raises(UserError, match=r"blind\.mcap: no scan in it"):
        rerun_command(RerunOptions(blind, EXACT), None, console)
    lost = made.write(tmp_path / "lost.mcap", world=False)
    with pytest.raises(UserError, match="no world was recorded: give one with --world"):
        rerun_command(RerunOptions(lost, EXACT), None, console)


# What the recording holds of its services.


def holding(path, *, weights=True, card=None, file="corridor-precise.safetensors", digest=True, **values):
    writer = RecordingWriter(path)
    config = {"estimator": "precise", "world": "corridor", "robot": "r", "connect": "tcp/x", **values}
    writer.metadata("config:estimator", {"config": json.dumps(config)})
    data = SHIPPED.read_bytes() if weights else b""
    said = {"estimator": "precise", "card": card or SHIPPED.with_suffix(".json").read_text(), "file": file}
    if digest:
        said["sha256"] = hashlib.sha256(SHIPPED.read_bytes()).hexdigest()
    writer.metadata("model", said)
    writer.attachment("world.yaml", b"name: the session's", "application/yaml", 0)
    writer.attachment("model/world.yaml", b"name: the estimator's", "application/yaml", 0)
    if data:
        writer.attachment(f"model/{file}", data, "application/octet-stream", 0)
    return read_recording(writer.finish())


def settings_from(recording, folder):
    return estimator_settings(recording, folder, recorded_settings(recording, "estimator").values).values


def test_world_and_weights_come_out_of_the_file(tmp_path):
    recording = holding(tmp_path / "r.mcap", models="/somewhere/else", sigma=0.03)
    values = settings_from(recording, tmp_path)
    assert values["sigma"] == 0.03
    assert not {"robot", "connect"} & values.keys()
    assert Path(values["world"]).read_bytes() == b"name: the estimator's"
    unpacked = Path(values["models"]) / SHIPPED.name
    assert unpacked.read_bytes() == SHIPPED.read_bytes()
    assert unpacked.with_suffix(".json").read_bytes() == SHIPPED.with_suffix(".json").read_bytes()
    assert tmp_path in unpacked.parents


def test_shipped_weights_serve_where_they_are_the_recorded_ones(tmp_path):
    assert settings_from(holding(tmp_path / "r.mcap", weights=False), tmp_path)["models"] == str(SHIPPED.parent)


def test_other_weights_do_not(tmp_path):
    card = json.dumps({**json.loads(SHIPPED.with_suffix(".json").read_text()), "seed": 99})
    with pytest.raises(UserError, match=r"corridor-precise\.safetensors are not in it, and none here are the recorded"):
        settings_from(holding(tmp_path / "r.mcap", weights=False, card=card, digest=False), tmp_path)
    recording = holding(tmp_path / "d.mcap")
    recording.attachments["model/corridor-precise.safetensors"] += b"x"
    with pytest.raises(UserError, match="their digest differs from the recorded one"):
        settings_from(recording, tmp_path)


@pytest.mark.parametrize("file", ["../evil.safetensors", "/etc/evil.safetensors", ".safetensors", "model.pt"])
def test_a_name_that_is_a_path_is_not_written_to(tmp_path, file):
    with pytest.raises(UserError, match="which is not a file name"):
        settings_from(holding(tmp_path / "r.mcap", file=file), tmp_path)
    assert not list(tmp_path.rglob("*evil*"))


def test_no_weights_are_asked_for_where_nothing_was_learned(tmp_path):
    values = settings_from(
        holding(tmp_path / "r.mcap", weights=False, card="{}", estimator="particle-filter"), tmp_path
    )
    assert values["estimator"] == "particle-filter"


def test_settings_of_another_version_are_named(tmp_path):
    unpacked = recorded_settings(holding(tmp_path / "r.mcap", telepathy=True), "estimator")
    assert "telepathy" not in unpacked.values
    assert "does not know: telepathy" in unpacked.notes[0]
    assert recorded_settings(holding(tmp_path / "s.mcap"), "controller") is None


# Comparing.

STAMPS = st.lists(st.integers(0, 5), max_size=20)


@given(STAMPS, STAMPS, st.randoms(use_true_random=False))
def test_the_kth_of_a_stamp_is_compared_with_the_kth_in_whatever_order_they_come(old, new, random):
    """Payloads say which they are: free energy is 10 k + stamp, so that equal means the right two met."""
    events = [(False, stamp, old[:i].count(stamp)) for i, stamp in enumerate(old)]
    ours = [(True, stamp, new[:i].count(stamp)) for i, stamp in enumerate(new)]
    merged = []
    while events or ours:
        take = events if events and (not ours or random.random() < 0.5) else ours
        merged.append(take.pop(0))
    pairs = MessagePairs()
    for mine, stamp, k in merged:
        (pairs.add_new if mine else pairs.add_recorded)(belief(stamp, free_energy=10.0 * k + stamp))
    expected = sum(min(old.count(stamp), new.count(stamp)) for stamp in set(old))
    assert pairs.compared == pairs.equal == expected
    assert pairs.unmatched()["recorded"] == len(old) - expected
    assert pairs.unmatched()["new"] == len(new) - expected


@pytest.mark.parametrize(
    "other",
    [
        belief(1, x=1e-16), belief(1, free_energy=np.nextafter(1.0, 2)), belief(1, covariance=np.eye(3)),
        belief(1, state="lost"),
    ],
)  # fmt: skip
def test_a_bit_is_seen(other):
    outcome = ReplayOutcome(lockstep=True)
    outcome.beliefs.add_recorded(belief(1))
    outcome.beliefs.add_new(other)
    assert outcome.beliefs.compared == 1
    assert not outcome.beliefs.equal
    assert not outcome.good
    assert ReplayOutcome(lockstep=False, beliefs=outcome.beliefs).good  # within the tolerance


def test_nothing_compared_is_not_good():
    assert not ReplayOutcome(lockstep=True).good
    assert not ReplayOutcome(lockstep=False).good


def test_commands_are_compared_by_what_they_say():
    pairs = MessagePairs()
    pairs.add_recorded(CmdVel(stamp_ns=1, seq=5, twist=Twist(vx=1.0)))
    pairs.add_new(CmdVel(stamp_ns=1, seq=9, twist=Twist(vx=1.0)))
    pairs.add_recorded(CmdVel(stamp_ns=2, twist=Twist(vx=1.0)))
    pairs.add_new(CmdVel(stamp_ns=2, twist=Twist(vx=0.75)))
    assert (pairs.compared, pairs.equal, pairs.max_speed_difference) == (2, 1, 0.25)


def test_errors_are_of_the_truth_of_the_same_run_though_stamps_come_again():
    track = ComparisonBuilder(BeliefSeries(), BeliefSeries("new"))
    for run, x in ((0, 1.0), (1, 5.0)):  # the simulation was begun anew
        at = run * 10**9
        track.add_truth(Truth(stamp_ns=7, pose=Pose(x=x, y=0.0, yaw=np.pi), twist=Twist()), at)
        track.old.add(belief(7, x=x + 0.1, yaw=-np.pi + 0.01), at + 5, 3.0)
        track.new.add(belief(7, x=x + 0.2, yaw=np.pi, covariance=np.diag([0.01, 0.01, 0.01])), at + 5, 2.0)
    numbers = track.compare().as_dict()
    assert numbers["scans_compared"] == 2
    assert numbers["recorded"]["position_error_max_m"] == pytest.approx(0.1)
    assert numbers["recorded"]["heading_error_median_rad"] == pytest.approx(0.01)
    assert numbers["new"]["nees_mean"] == pytest.approx(0.2**2 / 0.01)
    assert numbers["difference"]["position_max_m"] == pytest.approx(0.1)


def test_only_scans_both_answered_are_compared():
    track = ComparisonBuilder(BeliefSeries(), BeliefSeries("new"))
    for stamp in range(10):
        track.add_truth(Truth(stamp_ns=stamp, pose=Pose(x=0.0, y=0.0), twist=Twist()), stamp)
        track.new.add(belief(stamp, x=1.0 if stamp < 5 else 0.5), stamp, 1.0)
        if stamp >= 5:
            track.old.add(belief(stamp), stamp, 1.0)
    numbers = track.compare().as_dict()
    assert numbers["scans_answered"] == {"recorded": 5, "new": 10}
    assert numbers["new"]["position_error_max_m"] == 0.5


# When a controller took its goals.


def said(*entries):
    """``g``: a status about a goal just taken; a number: a belief of that stamp is answered, with a goal or without."""
    goals, last, goal, messages = GoalTimes(), 0, None, []
    for entry in entries:
        if entry == "g":
            goal = Pose(x=1.0, y=1.0)
            messages.append(Status(stamp_ns=last, state="navigating", goal=goal))
        else:
            last = entry
            distance = 1.0 if goal else None
            messages.append(Status(stamp_ns=last, state="idle", goal=goal, distance=distance))
            messages.append(CmdVel(stamp_ns=last, twist=Twist()))
    goals.add(messages)
    return goals


def test_a_status_without_a_command_is_a_goal_taken():
    assert said(1, 2, "g", 3, "g", "g", 4).accepted(3) == {2: 1, 3: 2}
    assert said("g", 0, 1).accepted(1) == {None: 1}
    assert said(0, "g", 1).accepted(1) == {0: 1}
    assert said(1, 2).accepted(0) == {}
    assert said(1, "g", 2).accepted(2) is None  # a goal nobody took
    assert GoalTimes().accepted(1) is None


def test_the_end_of_a_recording_may_cut_an_answer_in_two():
    goals = said(1, "g", 2)
    goals.add([Status(stamp_ns=3, state="navigating", goal=Pose(x=1.0, y=1.0), distance=1.0)])
    assert goals.accepted(1) == {1: 1, 3: 0}


def test_a_damaged_recording_proves_nothing():
    outcome = ReplayOutcome(lockstep=True)
    belief = Belief(
        stamp_ns=1, state="tracking", pose=Pose(x=0.0, y=0.0), xi=np.zeros(3, np.float32), free_energy=0.0, accuracy=0.0
    )
    outcome.beliefs.add_recorded(belief)
    outcome.beliefs.add_new(belief)
    assert outcome.good
    outcome.damaged = "damaged: a chunk's checksum"
    assert not outcome.good
    assert "what comes after that was not compared" in describe(outcome)[-1]
