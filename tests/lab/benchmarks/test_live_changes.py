"""The benchmark of learning while driving where furniture was moved."""

from __future__ import annotations

from lab.benchmarks import building_drives
from lab.benchmarks.live_changes import AFTER, BEFORE, PRESENT, follow_changes, table


def test_short_drive(monkeypatch):
    monkeypatch.setattr(building_drives, "PRESENT_SCANS", 60)  # of each model: enough to find single scans
    row = follow_changes("office", seed=2, seconds=4.0, scans=3)
    assert [len(row[model]) for model in (BEFORE, AFTER, PRESENT)] == [3, 3, 3]
    assert None in row[BEFORE]  # because of the moved furniture
    assert max(row[PRESENT]) < 0.01
    assert row[BEFORE] == row[AFTER]  # too short to learn anything
    assert row["versions"] == []


def test_table():
    text = table([{"world": "office", BEFORE: [0.002, None], AFTER: [0.001, 0.003], PRESENT: [0.001, 0.001]}])
    assert "| office | 1/2; 2.00 | 2/2; 2.00 | 2/2; 1.00 |" in text
