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
    """Tasks of the accuracy benchmark and moved furniture: presage, the best particle filter, and a scan matcher."""
    rows = {(row["task"], row["estimator"]): row for row in read(folder / "accuracy.json")["rows"]}
    lines = []
    for label, task in TASKS.items():
        own, matcher = rows[task, "precise"], rows[task, "correlative"]
        best = _best_filter([row for (of_task, _), row in rows.items() if of_task == task])
        variant = best["estimator"].removeprefix("particle-filter").removeprefix("-").replace("-", " ") or "tuned"
        bound = f"{number(1e3 * own['bound_rms_m'], 2)} mm" if own["bound_rms_m"] else ""
        lines.append([label, cell(own), f"{variant}: {cell(best)}", cell(matcher), bound])
    moved = read(folder / "integrity-moved-50.json")["summary"]
    own, tuned = (_integrity(moved[name]["moved-50"]) for name in ("precise", "particle-filter"))
    lines.append([MOVED, own, f"tuned: {tuned}", "", ""])
    return markdown(["", "presage", "best particle filter", "scan matcher", "bound (RMS)"], lines)


def _best_filter(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The particle filter with the most poses found, less those wrongly claimed; of several, the most exact one."""
    filters = [row for row in rows if row["estimator"].startswith("particle-filter")]
    return max(
        filters,
        key=lambda row: (row["found"] - row["tracking_but_wrong"], -(row["position_error_rms_m"] or float("inf"))),
    )


def _integrity(row: dict[str, Any]) -> str:
    tracking, wrong = (100 * row[name]["count"] / row[name]["of"] for name in ("tracking", "wrong"))
    low, high = (100 * bound for bound in row["wrong"]["interval_95"])
    return f"{tracking:.1f} % `tracking`, of which {wrong:.1f} % wrong ({low:.2g} to {high:.2g} %)"


TABLES = {"readme-real": real_logs, "readme-simulation": simulation, "peers": table_with_others}
