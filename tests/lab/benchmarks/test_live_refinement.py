"""The benchmark of learning while driving."""

from __future__ import annotations

from lab.benchmarks.live_refinement import refine, table


def test_short_drive():
    """A drive that is too short to learn from leaves the map as rough as it is."""
    row = refine("office", 5004, 3.0)
    assert row["versions"] == []
    assert row["rough"] == row["after"]
    assert row["tracking_median_ms"] > 0
    cells = table([row]).splitlines()[2].split("|")
    assert cells[1].strip() == "office"
    assert cells[2] == cells[3]
