"""`presage info` and `presage echo` on files, and the commands of the group."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console
from typer.testing import CliRunner

from common.bus.bus import Link
from common.errors import UserError
from common.messages.definitions import Odom, Pose, Twist
from common.messages.topics import BELIEF, ODOM, SCAN, TRUTH
from presage.cli.main import app
from presage.recordings import info as information
from presage.recordings.info import collect_facts
from presage.recordings.printing import echo_either, info
from services.recorder.reader import read_recording
from tests.presage.recordings import artificial_session as driven

KEY = ODOM.key("rob")


def odoms(*numbers, began=driven.BEGAN_NS):
    """Odometry with these sequence numbers, 10 a second."""
    for at, number in enumerate(numbers):
        message = Odom(stamp_ns=at, seq=number, pose=Pose(x=0.0, y=0.0), twist=Twist(), covariance=[[0.0] * 3] * 3)
        yield ODOM, KEY, message.encode(), began + at * 10**8


def facts_of(path, check=None):
    facts = collect_facts(read_recording(path), check)
    return facts, {row.key: row for row in facts.topics}


def test_facts(tmp_path):
    facts, rows = facts_of(driven.write(tmp_path / "run.mcap"))
    assert facts.complete
    assert facts.checked
    assert (facts.robots, facts.world) == (["rob"], "hall")
    assert facts.started == "2023-11-14T22:13:20.000+00:00"
    assert facts.duration_s == pytest.approx(1.1 + 0.009, abs=1e-3)
    scan = rows[SCAN.key("rob")]
    assert (scan.messages, scan.rate_hz) == (driven.STEPS, pytest.approx(10.0))
    assert scan.bytes == sum(len(message.encode()) for topic, _, message, _ in driven.events() if topic == SCAN)
    assert (scan.gaps, scan.missing, scan.restarts, scan.undecodable) == (0, 0, 0, 0)
    assert rows["presage/rob/goal"].gaps is None  # goals are not numbered
    assert facts.versions == {"commit": "abc"}
    assert facts.metadata["presage"] == ["robot", "commit"]
    assert facts.attachments.keys() == {"world.yaml"}
    assert facts.dropped_by_services == {f"estimator {SCAN.key('rob')}": 2}


def test_gaps_in_sequence_numbers(tmp_path):
    path = driven.write(tmp_path / "run.mcap", ODOM, also=odoms(0, 1, 2, 5, 6, 9, 0, 1))
    row = facts_of(path)[1][KEY]
    assert (row.messages, row.gaps, row.missing, row.restarts) == (8, 2, 4, 1)
    console = Console(file=io.StringIO(), width=150)
    assert info(path, None, None, console) == 1
    assert "readable, but 4 messages are missing" in console.file.getvalue()


def test_facts_without_payloads(tmp_path, monkeypatch):
    path = driven.write(tmp_path / "run.mcap", ODOM, also=odoms(0, 7))
    facts, rows = facts_of(path, check=False)
    assert (rows[KEY].messages, rows[KEY].bytes, rows[KEY].gaps) == (2, None, None)
    assert rows[SCAN.key("rob")].rate_hz == pytest.approx(driven.STEPS / facts.duration_s)
    monkeypatch.setattr(information, "MAX_CHECKED_BYTES", 1000)
    assert [facts_of(path, check)[0].checked for check in (False, None, True)] == [False, False, True]


def test_counts_of_the_recorder(tmp_path):
    recording = read_recording(driven.write(tmp_path / "run.mcap", ODOM))
    counted = {"received": 9, "written": 8, "dropped": 1, "oversized": 0, "gaps": 2, "missing": 3, "restarts": 0}
    recording.metadata["counters"] = {KEY: json.dumps(counted), SCAN.key("rob"): "nonsense"}
    rows = {row.key: row for row in collect_facts(recording, check=False).topics}
    assert (rows[KEY].messages, rows[KEY].dropped, rows[KEY].gaps, rows[KEY].missing) == (0, 1, 2, 3)
    assert rows[KEY].counters["received"] == 9
    assert rows[SCAN.key("rob")].counters == {}


def test_info_text_and_json(tmp_path):
    path, console = driven.write(tmp_path / "run.mcap"), Console(file=io.StringIO(), width=150)
    assert info(path, tmp_path / "facts.json", None, console) == 0
    text = console.file.getvalue()
    shown = ("complete, all checksums are correct", "hall", "rob", SCAN.key("rob"), "world.yaml", "2 of presage/rob/sc")
    assert [part for part in shown if part not in text] == []
    numbers = json.loads((tmp_path / "facts.json").read_text())
    assert numbers["complete"] is True
    assert {row["key"] for row in numbers["topics"]} >= {KEY, SCAN.key("rob")}


@pytest.mark.parametrize("damage", ["active", "cut", "header only"])
def test_info_of_an_incomplete_file(tmp_path, damage):
    path = driven.write(tmp_path / "run.mcap", finish=damage != "active")
    data = bytearray(path.read_bytes())
    if damage == "cut":
        del data[-40:]
    elif damage == "header only":
        del data[12:]
    path.write_bytes(data)
    console = Console(file=io.StringIO(), width=150)
    assert info(path, None, None, console) == 1
    text = console.file.getvalue()
    assert "INCOMPLETE" in text
    assert "presage recover" in text


def echoed(capsys, source, topic=None, count=0, start=0.0, full=False):
    status = echo_either(Link(), str(source), topic, count, start, Console(width=150), full=full)
    return status, [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_echo_of_a_file(tmp_path, capsys):
    path = driven.write(tmp_path / "run.mcap", also=[(TRUTH, TRUTH.key("rob"), b"\xc1", driven.BEGAN_NS)])
    status, lines = echoed(capsys, path, "belief", count=2, start=0.45)
    assert status == 0
    assert [line["seq"] for line in lines] == [5, 6]
    assert lines[0]["key"] == BELIEF.key("rob")
    assert lines[0]["time_s"] == pytest.approx(0.509)
    assert lines[0]["pose"]["x"] == driven.believed(5)[0]
    assert len(echoed(capsys, path)[1]) == sum(read_recording(path).counts.values())
    assert echoed(capsys, path, SCAN.key("rob"), 1, full=True)[1][0]["ranges"] == [1.0, "inf", "-inf", 2.5]
    assert echoed(capsys, path, "belief", start=100.0) == (1, [])
    (bad,) = (line for line in echoed(capsys, path, "truth")[1] if "undecodable" in line)
    assert bad["bytes"] == 1


def test_echo_of_an_unfinished_file_warns(tmp_path, capsys):
    path = driven.write(tmp_path / "run.mcap", finish=False)
    assert echo_either(Link(), str(path), "truth", 1, 0.0, Console(), full=False) == 0
    assert "incomplete" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "topic", "message"),
    [
        ("nothing", "scan", "no topic 'nothing': choose one of scan"),
        ("missing.mcap", None, "missing.mcap: cannot be read"),
        ("run.mcap", "nothing", "no topic 'nothing'"),
        ("run.mcap", "truth", r"run\.mcap: no truth in it; it has scan, odom, belief"),
        ("belief", "odom", "belief is a topic on the bus"),  # although there is a file of that name
    ],
)
def test_echo_refusals(tmp_path, monkeypatch, source, topic, message):
    driven.write(tmp_path / "run.mcap", TRUTH)
    (tmp_path / "belief").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message):
        echo_either(Link(), source, topic, 0, 0.0, Console(), full=False)


def test_commands(tmp_path):
    path = driven.write(tmp_path / "run.mcap")
    assert CliRunner().invoke(app, ["info", str(path), "--no-check"]).exit_code == 0
    line = CliRunner().invoke(app, ["echo", str(path), "belief", "-n", "1", "--start", "0.5"]).stdout
    assert json.loads(line)["seq"] == 5
    for to, made in (("csv", "run-csv/belief.csv"), ("tum", "run-tum/belief.tum"), ("foxglove", "run-foxglove.mcap")):
        assert CliRunner().invoke(app, ["export", str(path), "--format", to]).exit_code == 0
        assert (tmp_path / made).stat().st_size > 0


def test_plot_of_an_unfinished_recording(tmp_path):
    path = driven.write(tmp_path / "run.mcap", finish=False)
    done = CliRunner().invoke(app, ["plot", str(path), "--json", str(tmp_path / "run.json")])
    assert done.exit_code == 0
    assert "incomplete" in done.stdout
    assert (tmp_path / "run.png").exists()
    assert json.loads((tmp_path / "run.json").read_text())["scans"] == driven.STEPS
