"""Each service answers a session as in its reference; otherwise the differences are reported readably."""

from __future__ import annotations

import copy
import functools
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.process_replay import reference
from tests.process_replay.bless import bless, main
from tests.process_replay.sessions import SESSIONS


@functools.cache
def rows_of(name):
    """The service's current rows; it runs once for all tests."""
    with tempfile.TemporaryDirectory() as folder:
        return SESSIONS[name](Path(folder))


def differences(name, rows):
    return list(reference.compare(reference.read(name), rows))


@pytest.mark.parametrize("name", SESSIONS)
def test_a_service_answers_as_its_reference_says(name):
    found = differences(name, rows_of(name))
    if found:
        pytest.fail(f"{reference.report(name, found)}\nIf this change is intended: make bless", pytrace=False)


def test_references_are_there_small_and_of_sessions_alone():
    files = sorted(reference.FOLDER.iterdir())
    assert [file.stem for file in files] == sorted(SESSIONS)
    assert sum(file.stat().st_size for file in files) < 150_000


@pytest.mark.parametrize("name", ["simulator", "controller-geodesic", "controller-paper"])
def test_a_session_generated_again_is_the_same(name, tmp_path):
    assert SESSIONS[name](tmp_path) == rows_of(name)


def test_a_step_size_ten_percent_larger_is_noticed_and_reads_well(tmp_path):
    found = differences("controller-paper", SESSIONS["controller-paper"](tmp_path, gamma=0.33))
    text = reference.report("controller-paper", found)
    lines = text.splitlines()
    assert lines[0].startswith("controller-paper: ")
    assert "message(s) differ from the reference" in lines[0]
    first = lines[1]
    assert first.startswith("  message ")
    assert "(cmd_vel, stamp " in first
    assert "twist.v" in first
    assert ": expected " in first
    assert ", got " in first
    assert "(off by " in first
    assert any("x cmd_vel twist.vx, by up to 0.0" in line for line in lines)
    assert not any("status" in line for line in lines)  # its distance is of the belief, which is given
    assert len(lines) < 16
    assert max(map(len, lines)) < 160


@pytest.mark.parametrize(
    ("name", "changes", "reported"),
    [
        ("simulator", {"seed": 6}, "scan"),
        ("simulator", {"drive": "differential"}, "truth"),
        ("controller-paper", {"belief_timeout": 0.7}, "no belief for 0.7 s"),
        ("controller-paper", {"world": ""}, 'state: expected "blocked", got "navigating"'),
        ("recorder", {"topics": "scan"}, "odom"),
        ("estimator-paper", {"alpha": 2.2e-3}, "belief"),
    ],
)
def test_a_change_is_noticed(name, changes, reported, tmp_path):
    found = differences(name, SESSIONS[name](tmp_path, **changes))
    assert found
    assert reported in reference.report(name, found, first=1000)


ROWS = [
    {"event": 0, "topic": "belief", "stamp_ns": 0, "state": "tracking", "pose": {"x": 1.0, "y": 2.0}, "hypotheses": []},
    {
        "event": 1,
        "topic": "belief",
        "stamp_ns": 5_000_000,
        "state": "lost",
        "pose": {"x": 9.0, "y": 2.0},
        "xi": [1.0, 2.0],
    },
    {"event": 1, "reply": "localise", "ok": True},
    {"end": {"counters": {"scans": 2}, "failed": 0}},
]


def changed(change):
    rows = copy.deepcopy(ROWS)
    change(rows)
    return rows


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (
            lambda r: r[1].update(state="tracking"),
            'message 1 (belief, stamp 0.005 s): state: expected "lost", got "track',
        ),
        (lambda r: r[1]["pose"].update(x=9.001), "pose.x: expected 9, got 9.001 (off by 0.001, allowed 4.6e-05)"),
        (lambda r: r[1]["pose"].update(x=float("inf")), "pose.x: expected 9, got inf"),
        (lambda r: r[1]["pose"].update(x=float("nan")), "pose.x: expected 9, got nan"),
        (lambda r: r[1]["xi"].__setitem__(1, 2.5), "xi[1]: expected 2, got 2.5 (off by 0.5, allowed 0.01)"),
        (lambda r: r[1]["xi"].append(0.0), "xi: expected [1.0, 2.0], got [1.0, 2.0, 0.0]"),
        (lambda r: r[1].pop("xi"), "xi: expected [1.0, 2.0], got nothing"),
        (lambda r: r[0].update(covariance=[1.0]), "covariance: expected nothing, got [1.0]"),
        (lambda r: r[3]["end"]["counters"].update(scans=3), "end.counters.scans: expected 2, got 3"),
        (lambda r: r[2].update(ok=False), "message 2 (reply localise): ok: expected true, got false"),
        (lambda r: r[0].update(event=1), "event: expected 0, got 1"),
        (lambda r: r.pop(1), "message 1 (belief, stamp 0.005 s): missing"),
        (lambda r: r.pop(), "message 3 (end): missing"),
        (lambda r: r.append({"event": 2, "topic": "scan"}), "message 4 (scan): new, the reference has none"),
        (lambda r: r.insert(1, {"event": 0, "topic": "scan"}), "message 1 (scan): new, the reference has none"),
    ],
)
def test_any_difference_is_named(change, reported):
    (found,) = reference.compare(ROWS, changed(change))
    assert reported in f"{found}"
    assert len(f"{found}") < 250


def test_another_stamp_is_another_message():
    later = changed(lambda r: r[1].update(stamp_ns=6_000_000))
    assert [str(each) for each in reference.compare(ROWS, later)] == [
        "message 1 (belief, stamp 0.005 s): missing",
        "message 1 (belief, stamp 0.006 s): new, the reference has none",
    ]


@given(st.floats(-1e6, 1e6), st.sampled_from(["pose.x", "xi[0]"]))
def test_what_another_processor_rounds_differently_is_the_same(value, field):
    allowed = reference.tolerance(field, value)
    wrap = (lambda v: {"pose": {"x": v}}) if field == "pose.x" else (lambda v: {"xi": [v]})
    for near in (value, value + 0.9 * allowed, value - 0.9 * allowed, float(f"{value:.7g}")):
        assert not list(reference.compare([wrap(value)], [wrap(near)]))
    assert list(reference.compare([wrap(value)], [wrap(value + 1.1 * allowed + 1e-9)]))


def test_long_arrays_are_a_few_numbers_in_which_any_beam_shows():
    values = np.linspace(1, 5, 622)
    values[10], values[20] = np.inf, -np.inf
    row = reference.of_array(values)
    assert row["count"] == 622
    assert (row["inf"], row["-inf"]) == (1, 1)
    assert len(row["every 104"]) == 6
    for beam in (0, 1, 300, 621):
        other = values.copy()
        other[beam] += 0.01
        assert list(reference.compare([{"ranges": row}], [{"ranges": reference.of_array(other)}])), beam


def test_a_covariance_is_scale_and_correlation():
    row = reference.of_symmetric(np.array([[4e-6, 1e-6, 0], [1e-6, 1e-6, 0], [0, 0, 0]]))
    assert row["root"] == pytest.approx([2e-3, 1e-3, 0])
    assert row["correlation"] == pytest.approx([0.5, 0, 0])


def test_bless_says_what_changed_and_writes_that_alone(tmp_path):
    reported = []
    assert bless("x", ROWS, tmp_path, report=reported.append)
    assert reported[0] == "x: no reference yet; 4 messages"
    path = tmp_path / "x.jsonl"
    first, inode = path.read_text(), path.stat().st_mtime_ns
    assert not bless("x", changed(lambda r: r[1]["pose"].update(x=9.00001)), tmp_path, report=reported.append)
    assert reported[-1] == "x: unchanged"
    assert (path.read_text(), path.stat().st_mtime_ns) == (first, inode)

    def both(rows):
        rows[0]["pose"]["x"] = 1.000001  # within tolerance: that line stays
        rows[1]["pose"].update(x=9.5, y=2.000001)

    reported.clear()
    assert bless("x", changed(both), tmp_path, write=False, report=reported.append)
    assert path.read_text() == first
    assert bless("x", changed(both), tmp_path, report=reported.append)
    assert "pose.x: expected 9, got 9.5" in reported[1]
    assert "1 of 4 lines new" in reported[2]
    before, after = first.splitlines(), path.read_text().splitlines()
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, True, True]
    assert '"x": 9.5, "y": 2.0}' in after[1]
    assert not bless("x", changed(both), tmp_path, report=reported.append)


@given(st.lists(st.sampled_from(ROWS), max_size=6), st.lists(st.sampled_from(ROWS), max_size=6))
def test_what_was_blessed_is_what_is_expected_from_then_on(old, new):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        reference.write("x", old, folder)
        bless("x", new, folder, report=lambda _: None)
        assert not list(reference.compare(reference.read("x", folder), new))
        assert len(reference.read("x", folder)) == len(new)


def test_a_session_nobody_knows_is_refused():
    with pytest.raises(SystemExit, match="no session other: choose from simulator"):
        main(["other"])
