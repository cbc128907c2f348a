"""The benchmark of learning while driving."""

from __future__ import annotations

from lab.benchmarks.live_refinement import table


def test_table():
    before, after = (
        {"position_median_m": k, "position_rms_m": 2 * k, "position_max_m": 3 * k, "aligned_median_m": k / 2}
        for k in (0.02, 0.002)
    )
    text = table([{"world": "office", "rough": before, "after": after}])
    assert "| office | 20.0; 40.0; 60.0 | 2.00; 4.00; 6.00 | 10.0 | 1.00 |" in text
