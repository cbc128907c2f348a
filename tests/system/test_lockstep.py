"""Lockstep sessions: the same seed gives the same bytes, and a recording alone gives the same beliefs again."""

from __future__ import annotations

import json
import shutil

import pytest
from rich.console import Console

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox
from common.messages.definitions import Belief, Goal, Health, Pose, Scan
from common.messages.topics import BELIEF, CMD_VEL, GOAL, HEALTH, ODOM, PREDICTION, SCAN, STATUS, TRUTH, topic_of
from presage.logs.importing import ImportOptions, import_command
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import read_recording
from tests.conftest import ROOT, WAIT_TIMEOUT_S, wait_for_message
from tests.estimator.models import change_weights
from tests.presage.logs.drives import Bag, write_bag

SCANS = 90
REPEATED = (SCAN, ODOM, TRUTH, BELIEF, PREDICTION, STATUS, CMD_VEL)
SERVICES = {"recorder", "controller", "estimator", "simulator"}
WEIGHTS = "corridor-precise"


class Session:
    """Records localisation and driving for SCANS scans, with weights that differ from the shipped ones."""

    def __init__(self, processes, port) -> None:
        self.folder, self.models, self.processes = processes.folder, processes.folder / "models", processes
        self.link = Link(robot="lockstep", connect=(f"tcp/127.0.0.1:{port}",))
        self.models.mkdir()
        for suffix in ("safetensors", "json"):
            shutil.copy(ROOT / "models" / f"{WEIGHTS}.{suffix}", self.models)
        change_weights(self.models / f"{WEIGHTS}.safetensors")

    def start(self, name, *args, **env):
        ours = {"PRESAGE_CONNECT": self.link.connect[0], "PRESAGE_ROBOT": self.link.robot}
        return self.processes.start(name, *args, env={**ours, **env})

    def command(self, *args, **env):
        """Runs a command with ``--json``. Returns its status, output and numbers."""
        numbers = self.folder / "numbers.json"
        numbers.unlink(missing_ok=True)
        done = self.start("presage.__main__", *map(str, args), "--json", str(numbers), **env)
        return done.wait(120), done.output, json.loads(numbers.read_text()) if numbers.exists() else {}

    def record(self, name):
        """Returns the recording, with the test as one more service that the simulator waits for."""
        with open_bus(self.link) as bus:
            inbox = Inbox()
            for topic in (SCAN, HEALTH):
                bus.subscribe(topic, inbox, keep_all=True)
            wait_for = f"estimator,controller,recorder,{name}"
            started = [
                self.start("recorder", "--directory", str(self.folder), "--file", f"{name}.mcap"),
                self.start("controller", "--belief-timeout", "60"),
                self.start("estimator", "--initial-pose", "3.2,1.4", "--models", str(self.models)),
                # A busy machine must not make it send a scan again.
                self.start(
                    "simulator", "--pace", "lockstep", "--lockstep-deadline", str(WAIT_TIMEOUT_S), "--seed", "3",
                    "--beams", "622", "--wait-for", wait_for,
                ),
            ]  # fmt: skip
            assert wait_until(lambda: bus.alive() >= SERVICES, WAIT_TIMEOUT_S), [each.output for each in started]
            key = GOAL.key(bus.robot)
            bus.put(GOAL, Goal(stamp_ns=0, pose=Pose(x=15.5, y=1.5)).encode())
            wait_for_message(inbox, Health, lambda h: any(t.key == key and t.received for t in h.topics))
            bus.declare_alive(name)
            wait_for_message(inbox, Scan, lambda scan: scan.seq >= SCANS)
            active = self.folder / f"{name}.mcap.active"
            assert wait_until(lambda: b"model/world.yaml" in active.read_bytes(), 30), started[0].output
            for running in reversed(started):
                assert running.stop() == 0, running.output
        return read_recording(self.folder / f"{name}.mcap")


@pytest.fixture(scope="module")
def session(module_processes, router):
    return Session(module_processes, router)


@pytest.fixture(scope="module")
def recorded(session):
    """Two recordings and the weights they were made with, whose files are gone."""
    first, second = session.record("first"), session.record("second")
    weights = {path.name: path.read_bytes() for path in session.models.iterdir()}
    shutil.rmtree(session.models)
    return first, second, weights


@pytest.mark.parametrize("topic", REPEATED, ids=lambda topic: topic.name)
def test_same_seed_same_bytes(recorded, topic):
    first, second = (
        [raw.payload for raw in each.payloads() if topic_of(raw.key) is topic][:SCANS] for each in recorded[:2]
    )
    assert first == second
    assert len(first) == SCANS


def test_recorded_model(recorded):
    recording, _, weights = recorded
    model = recording.metadata["model"]
    assert (model["estimator"], model["file"]) == ("precise", f"{WEIGHTS}.safetensors")
    assert model["card"].encode() == weights[f"{WEIGHTS}.json"]
    assert {name: recording.attachments[f"model/{name}"] for name in weights} == weights
    moved = [truth.pose.x for _, truth, _ in recording.messages(TRUTH)]
    assert moved[-1] - moved[0] > 1.0  # the robot really drove


def test_replay_through_processes(session, recorded):
    """The recorded settings apply, not those of the environment."""
    status, output, numbers = session.command(
        "replay", session.folder / "first.mcap", "--with", "estimator,controller", PRESAGE_SIGMA="0.5"
    )
    assert status == 0, output
    assert numbers["lockstep"]
    for answers in (numbers["beliefs"], numbers["commands"]):
        assert answers["equal"] == answers["compared"] >= SCANS
    assert numbers["beliefs"]["position_difference_max_m"] == numbers["beliefs"]["recorded_without_new"] == 0
    assert "the results are identical" in output


def test_rerun_without_processes(session, recorded):
    status, output, numbers = session.command(
        "rerun", session.folder / "first.mcap", "--out", session.folder / "new.mcap"
    )
    assert status == 0, output
    assert set(numbers["difference"].values()) == {0.0}
    assert numbers["scans_compared"] >= SCANS
    old, new = [], []
    for raw in read_recording(session.folder / "new.mcap").payloads():
        if topic_of(raw.key) is BELIEF:
            (new if raw.key.split("/")[1].endswith("-rerun") else old).append(raw.payload)
    assert old == new[: len(old)]


def test_difference_of_a_nanometre(session, recorded):
    recording = recorded[0]
    writer, stamps = RecordingWriter(session.folder / "other.mcap"), []
    for name, values in recording.metadata.items():
        writer.metadata(name, values)
    for name, data in recording.attachments.items():
        writer.attachment(name, data, "application/octet-stream", 0)
    for raw in recording.payloads():
        topic, payload = topic_of(raw.key), raw.payload
        if topic is BELIEF and len(stamps) < 20:
            belief = Belief.decode(payload)
            stamps.append(belief.stamp_ns)
            pose = belief.pose.model_copy(update={"x": belief.pose.x + 1e-9 * (len(stamps) == 10)})
            payload = belief.model_copy(update={"pose": pose}).encode()
        if topic is SCAN and len(stamps) == 20:
            break
        writer.write(topic, raw.key, payload, raw.published_ns, raw.logged_ns)
    status, output, numbers = session.command("replay", writer.finish(), "--with", "estimator")
    assert status == 1, output
    assert numbers["beliefs"]["equal"] == numbers["beliefs"]["compared"] - 1
    assert 0.5e-9 < numbers["beliefs"]["position_difference_max_m"] < 2e-9
    assert "the results should be identical, but are not" in output


def test_replay_of_an_imported_log(session, tmp_path):
    imported = tmp_path / "there.mcap"
    log, quiet = write_bag(tmp_path, Bag(localised=True)), Console(quiet=True)
    import_command(ImportOptions(log, imported, world="corridor"), None, quiet, quiet)
    status, output, _ = session.command("replay", imported, "--with", "estimator")
    assert status == 2, output
    assert f"no beliefs to compare with; run an estimator on it with: presage localize {imported}" in output


def test_settings_of_a_successor(process, tmp_path):
    recorder = process("recorder", "--directory", str(tmp_path), "--file", "session")
    recorder.wait_for("ready")
    active = tmp_path / "session.mcap.active"
    for gamma in ("0.41", "0.42", "0.41"):
        known, setting = len(active.read_bytes()), f'"gamma": {gamma}'.encode()
        running = process("controller", "--gamma", gamma)
        assert wait_until(lambda at=known, t=setting: t in active.read_bytes()[at:], 30), recorder.output
        running.kill()  # without a clean end; the recorder must notice its successor anyway
    assert recorder.stop() == 0
    config = json.loads(read_recording(tmp_path / "session.mcap").metadata["config:controller"]["config"])
    assert config["gamma"] == 0.41
