"""Each service answers a session as in its reference."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from tests.process_replay import reference
from tests.process_replay.bless import bless
from tests.process_replay.sessions import SESSIONS


@pytest.mark.parametrize("name", SESSIONS)
def test_session_equals_reference(name, tmp_path):
    found = reference.compare(reference.read(name), SESSIONS[name](tmp_path))
    if found:
        lines = [f"{len(found)} differences, the first:", *found[:20], "If this change is intended: make bless"]
        pytest.fail("\n".join(lines), pytrace=False)


def test_references_belong_to_sessions():
    assert sorted(file.stem for file in reference.FOLDER.iterdir()) == sorted(SESSIONS)


@pytest.mark.parametrize(
    ("name", "changes", "reported"),
    [
        ("simulator", {"seed": 6}, "(scan, "),
        ("controller-paper", {"gamma": 0.33}, "twist.vx: expected "),
        ("controller-paper", {"world": ""}, 'state: expected "blocked", got "navigating"'),
        ("recorder", {"topics": "scan"}, "odom"),
    ],
)
def test_change_is_noticed(name, changes, reported, tmp_path):
    assert reported in "\n".join(reference.compare(reference.read(name), SESSIONS[name](tmp_path, **changes)))


ROWS = [
    {"event": 0, "topic": "belief", "stamp_ns": 0, "state": "tracking", "pose": {"x": 1.0, "y": 2.0}, "hypotheses": []},
    {"event": 1, "topic": "belief", "stamp_ns": 5_000_000, "pose": {"x": 9.0, "y": 2.0}, "xi": [1.0, 2.0]},
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
        (lambda r: r[0].update(state="lost"), 'message 0 (belief, stamp 0.000 s): state: expected "tracking", got "lo'),
        (lambda r: r[1]["pose"].update(x=9.001), "pose.x: expected 9, got 9.001"),
        (lambda r: r[1]["pose"].update(x=float("nan")), "pose.x: expected 9, got nan"),
        (lambda r: r[1]["xi"].__setitem__(1, 2.5), "xi[1]: expected 2, got 2.5"),
        (lambda r: r[1]["xi"].append(0.0), "xi: expected [1.0, 2.0], got [1.0, 2.0, 0.0]"),
        (lambda r: r[1].pop("xi"), "xi: expected [1.0, 2.0], got nothing"),
        (lambda r: r[3]["end"]["counters"].update(scans=3), "end.counters.scans: expected 2, got 3"),
        (lambda r: r[2].update(ok=False), "message 2 (reply localise): ok: expected true, got false"),
        (lambda r: r.pop(1), "message 1 (belief, stamp 0.005 s): missing"),
        (lambda r: r.insert(1, {"event": 0, "topic": "scan"}), "message 1 (scan): new, the reference has none"),
        (lambda r: r[1]["pose"].update(x=9.00001), None),  # another processor may round so
        (lambda r: r[1]["xi"].__setitem__(1, 2.009), None),
    ],
)
def test_differences(change, reported):
    found = reference.compare(ROWS, changed(change))
    assert len(found) == (reported is not None)
    assert reported is None or reported in found[0]


def test_any_beam_shows_in_an_array():
    values = np.linspace(1, 5, 622)
    values[10], values[20] = np.inf, -np.inf
    row = reference.of_array(values)
    assert (row["count"], row["inf"], row["-inf"]) == (622, 1, 1)
    for beam in (0, 1, 300, 621):
        other = values.copy()
        other[beam] += 0.01
        assert reference.compare([{"ranges": row}], [{"ranges": reference.of_array(other)}]), beam


def test_bless_keeps_unchanged_lines(tmp_path):
    assert len(bless("x", ROWS, tmp_path)) == len(ROWS)
    path = tmp_path / "x.jsonl"
    before = path.read_text().splitlines()

    def change(rows):
        rows[0]["pose"]["x"] = 1.000001  # within the tolerance
        rows[1]["pose"].update(x=9.5, y=2.000001)

    assert len(bless("x", changed(change), tmp_path, write=False)) == 1
    assert path.read_text().splitlines() == before
    bless("x", changed(change), tmp_path)
    after = path.read_text().splitlines()
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, True, True]
    assert '"x": 9.5, "y": 2.0}' in after[1]
    assert not bless("x", changed(change), tmp_path)
