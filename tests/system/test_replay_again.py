"""`presage replay FILE --with estimator` reproduces a lockstep session's beliefs bit for bit from its recording."""

from __future__ import annotations

import json

from rich.console import Console

from common.messages.definitions import Belief, Pose
from common.messages.topics import BELIEF, topic_of
from presage.logs.importing import ImportOptions, import_command
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import read_recording
from tests.presage.logs.drives import SCANS as SCANS_OF_LOG
from tests.presage.logs.drives import Bag, write_bag
from tests.recorder import sessions as made
from tests.system.test_loop import SCANS, run_in_lockstep


def command(process, numbers, *args, env=None):
    """Runs a command with ``--json``. Returns its status, output and numbers."""
    done = process("presage.__main__", *map(str, args), "--json", str(numbers), env=env)
    status = done.wait(120)
    return status, done.output, json.loads(numbers.read_text()) if numbers.exists() else {}


def alter_one_belief(recording, path, stamp_ns, count):
    """Writes the recording's first scans, with one belief moved by a nanometre."""
    writer, scans = RecordingWriter(path), 0
    for name, values in recording.metadata.items():
        writer.metadata(name, values)
    for name, data in recording.attachments.items():
        writer.attachment(name, data, "application/octet-stream", 0)
    for raw in recording.payloads():
        topic, payload = topic_of(raw.key), raw.payload
        scans += topic.name == "scan"
        if scans > count:
            break
        if topic is BELIEF and (belief := Belief.decode(payload)).stamp_ns == stamp_ns:
            moved = Pose(x=belief.pose.x + 1e-9, y=belief.pose.y, yaw=belief.pose.yaw)
            payload = belief.model_copy(update={"pose": moved}).encode()
        writer.write(topic, raw.key, payload, raw.published_ns, raw.logged_ns)
    return writer.finish()


def test_a_replayed_lockstep_session_gives_bit_identical_beliefs(process, bus, tmp_path):
    run_in_lockstep(process, bus, tmp_path, "run")
    file = tmp_path / "run.mcap"
    # The environment differs from the recorded settings and must be ignored.
    status, output, numbers = command(
        process, tmp_path / "a.json", "replay", file, "--with", "estimator,controller", env={"PRESAGE_SIGMA": "0.5"}
    )
    assert status == 0, output
    beliefs, commands = numbers["beliefs"], numbers["commands"]
    assert numbers["lockstep"]
    assert beliefs["equal"] == beliefs["compared"] >= SCANS
    assert beliefs["position_difference_max_m"] == 0.0
    assert beliefs["recorded_without_new"] == 0
    assert commands["equal"] == commands["compared"] >= SCANS
    assert "the results are identical" in output

    # The same without processes.
    status, output, numbers = command(process, tmp_path / "r.json", "rerun", file, "--out", tmp_path / "new.mcap")
    assert status == 0, output
    assert numbers["difference"] == {"position_median_m": 0.0, "position_max_m": 0.0, "heading_max_rad": 0.0}
    assert numbers["scans_compared"] >= SCANS
    bytes_of = {"robot": [], "robot-rerun": []}
    for raw in read_recording(tmp_path / "new.mcap").payloads():
        if raw.key.endswith("/belief"):
            whose = "robot-rerun" if raw.key.split("/")[1].endswith("-rerun") else "robot"
            bytes_of[whose].append(raw.payload)
    assert bytes_of["robot"] == bytes_of["robot-rerun"][: len(bytes_of["robot"])]

    # A difference of a nanometre is detected.
    stamp = Belief.decode(bytes_of["robot"][10]).stamp_ns
    other = alter_one_belief(read_recording(file), tmp_path / "other.mcap", stamp, 20)
    status, output, numbers = command(process, tmp_path / "o.json", "replay", other, "--with", "estimator")
    assert status == 1, output
    assert numbers["beliefs"]["equal"] == numbers["beliefs"]["compared"] - 1
    assert 0.5e-9 < numbers["beliefs"]["position_difference_max_m"] < 2e-9
    assert "the results should be identical, but are not" in output


def test_missing_contents_of_a_recording_are_reported(process, tmp_path):
    file = made.write(tmp_path / "made.mcap")  # not from a real session
    started = {
        "the estimator's configuration was not recorded": ("replay", str(file), "--with", "estimator"),
        "give estimator, or estimator,controller": ("replay", str(file), "--with", "simulator"),
        "leave out the options that choose what to replay": ("replay", str(file), "--with", "estimator", "--loop"),
        "go with --with": ("replay", str(file), "--every-scan"),
        "--robot 'a/b'": ("replay", str(file), "--robot", "a/b"),
    }
    running = {says: process("presage.__main__", *args) for says, args in started.items()}
    for says, command in running.items():
        assert command.wait(60) == 2, command.output
        (line,) = command.output.splitlines()
        assert says in line


def test_every_scan_of_an_imported_log_is_answered(process, tmp_path):
    """An imported log has no beliefs to compare with; the estimator has default settings and the import's world."""
    log = write_bag(tmp_path, Bag(localised=True))
    for name, world in (("there", "corridor"), ("nowhere", "")):
        import_command(
            ImportOptions(log, tmp_path / f"{name}.mcap", world=world), None, Console(quiet=True), Console(quiet=True)
        )
    status, output, numbers = command(
        process, tmp_path / "a.json", "replay", tmp_path / "there.mcap", "--with", "estimator"
    )
    assert status == 0, output
    assert numbers["imported"]
    assert (numbers["scans"], numbers["scans_unanswered"]) == (SCANS_OF_LOG, 0)
    assert numbers["tracking"] > SCANS_OF_LOG / 2
    assert "presage rerun" in output
    for file, services, why in (
        ("nowhere", "estimator", "import it again with --world"), ("there", "estimator,controller", "no goal"),
    ):  # fmt: skip
        status, output, _ = command(
            process, tmp_path / "b.json", "replay", tmp_path / f"{file}.mcap", "--with", services
        )
        assert status == 2
        assert why in output
