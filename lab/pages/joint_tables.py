"""Tables that are made from more than one result: those of README.md, and the comparison with other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lab.accuracy.report import cell
from lab.experiments.results import markdown, number, read
from lab.peers.experiment import table_with_others
from lab.real_logs.experiment import claims_of

PRESETS = {"precise": "presage", "particle-filter": "particle filter, tuned", "amcl-defaults": "AMCL-like defaults"}
# Labels in README, and the tasks of `presage bench accuracy`
TASKS = {
    "unknown start, 1 scan": "from nothing, 1 scan",
    "30 % blocked, 20 scans": "30 % blocked, 20 scans",
    "kidnapped, 20 scans": "kidnapped, 20 scans",
    "tracking, no odometry": "tracking, no odometry",
}
MOVED = "half of the furniture moved"


def real_logs(folder: Path) -> str:
    """A real log, for each estimator."""
    summary = read(folder / "real-fr079_exchanged.json")["summary"]
    odometry, laser, unknown = (
        [summary[f"{task}, {name}"] for name in PRESETS]
        for task in ("a: tracking with odometry", "b: tracking without", "c: from nothing")
    )
    claims = [f"{claims_of(row)}; {row['wrong_claim_longest_s']:.1f} s" for row in odometry]
    return markdown(
        ["", *PRESETS.values()],
        [
            ["pose correct, with odometry", *(f"{100 * row['tracked_share']:.1f} %" for row in odometry)],
            ["pose correct, laser alone", *(f"{100 * row['tracked_share']:.1f} %" for row in laser)],
            ["state `tracking`, wrong of these; longest (odometry)", *claims],
            ["unknown start found within 40 scans", *(f"{row['found']} of {row['trials']}" for row in unknown)],
        ],
    )


def simulation(folder: Path) -> str:
    """Tasks of the accuracy benchmark and moved furniture, for presage, the particle filter and a scan matcher."""
    rows = {(row["task"], row["estimator"]): row for row in read(folder / "accuracy.json")["rows"]}
    lines = []
    for label, task in TASKS.items():
        own = [rows.get((task, name)) for name in ("precise", "particle-filter", "correlative")]
        bound = next((row["bound_rms_m"] for row in own if row is not None), None)
        lines.append(
            [
                label,
                *("" if row is None else cell(row) for row in own),
                f"{number(1e3 * bound, 2)} mm" if bound else "",
            ]
        )
    moved = read(folder / "integrity-moved-50.json")["summary"]
    lines.append([MOVED, *(_integrity(moved[name]["moved-50"]) for name in ("precise", "particle-filter")), "", ""])
    return markdown(["", "presage", "particle filter", "scan matcher", "bound (RMS)"], lines)


def _integrity(row: dict[str, Any]) -> str:
    tracking, wrong = (100 * row[name]["count"] / row[name]["of"] for name in ("tracking", "wrong"))
    low, high = (100 * bound for bound in row["wrong"]["interval_95"])
    return f"{tracking:.1f} % `tracking`, of which {wrong:.1f} % wrong ({low:.2g} to {high:.2g} %)"


TABLES = {"readme-real": real_logs, "readme-simulation": simulation, "peers": table_with_others}
