"""Tables that are made from several results or from a part of one, in README.md and docs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lab.accuracy import report
from lab.experiments.results import markdown, number, read
from lab.peers.experiment import table_with_others
from lab.real_logs.drive import GLOBAL, KIDNAPPED, LASER, ODOMETRY
from lab.real_logs.experiment import wrong_share_of_tracking

# Labels in README, and the tasks of `presage experiment real` and of `presage bench accuracy`
REAL_TASKS = {
    "with odometry": ODOMETRY,
    "laser alone": LASER,
    "unknown start": GLOBAL,
    "kidnapped": KIDNAPPED,
}
REAL_FILTERS = {
    "particle-filter": "tuned",
    "particle-filter-scan-matching": "scan matching",
    "amcl-defaults": "AMCL's defaults",
}
TASKS = {
    "unknown start, 20 scans": "standing, 20 scans",
    "30 % blocked, 20 scans": "30 % blocked, 20 scans",
    "kidnapped, 20 scans": "kidnapped, 20 scans",
    "tracking, no odometry": "tracking, no odometry",
}
MOVED = "half of the furniture moved"
MOVED_FILTERS = {"start kept": "particle-filter", "recovery": "particle-filter-recovery"}


def real_logs(folder: Path) -> str:
    """A real log, for presage and the best particle filter: the second half in a map of the first, and the reverse.

    Each cell: scans with a correct pose, or starts found; scans in state `tracking`; and the wrong ones among these.
    """
    lines, longest_own, longest_best = [], 0.0, 0.0
    for half, name in (("second half", "real-fr079"), ("first half", "real-fr079_exchanged")):
        rows = list(read(folder / f"{name}.json")["summary"].values())
        for label, task in REAL_TASKS.items():
            (own,) = (row for row in rows if row["task"] == task and row["estimator"] == "precise")
            filters = [row for row in rows if row["task"] == task and not row["estimator"].startswith("precise")]
            best = max(filters, key=_correct_count)
            variant = REAL_FILTERS[best["estimator"]]
            lines.append([f"{half}: {label}", _real_cell(own), f"{variant}: {_real_cell(best)}"])
            longest_own = max(longest_own, own["longest_wrong_s"])
            longest_best = max(longest_best, best["longest_wrong_s"])
    lines.append(["longest wrong `tracking`", f"{longest_own:.1f} s", f"{longest_best:.1f} s"])
    return markdown(["", "presage", "best particle filter"], lines)


def _correct_count(row: dict[str, Any]) -> int:
    """The number of scans with a correct pose, or of starts found."""
    return int(row["correct"] if row["trials"] == 1 else row["found"])


def _real_cell(row: dict[str, Any]) -> str:
    correct = f"{row['correct'] / row['scans']:.1%}" if row["trials"] == 1 else f"{row['found']} of {row['trials']}"
    wrong = wrong_share_of_tracking(row)
    return f"{correct}; {row['tracking'] / row['scans']:.0%}, {'–' if wrong is None else f'{wrong:.1%}'}"


def simulation(folder: Path) -> str:
    """Tasks of the accuracy benchmark and moved furniture: presage, the best particle filter, and a scan matcher."""
    rows = {(row["task"], row["estimator"]): row for row in read(folder / "accuracy.json")["rows"]}
    lines = []
    for label, task in TASKS.items():
        own, matcher = rows[task, "precise"], rows[task, "correlative"]
        best = _best_filter([row for (of_task, _), row in rows.items() if of_task == task])
        variant = best["estimator"].removeprefix("particle-filter").removeprefix("-").replace("-", " ") or "tuned"
        bound = f"{number(1e3 * own['bound_rms_m'], 2)} mm" if own["bound_rms_m"] else ""
        lines.append([label, report.cell(own), f"{variant}: {report.cell(best)}", report.cell(matcher), bound])
    moved = read(folder / "integrity-moved-50.json")["summary"]
    filters = {name: moved[preset]["moved-50"] for name, preset in MOVED_FILTERS.items()}
    name, best = min(filters.items(), key=lambda each: each[1]["wrong"]["count"] / each[1]["wrong"]["of"])
    lines.append([MOVED, _integrity(moved["precise"]["moved-50"]), f"{name}: {_integrity(best)}", "", ""])
    return markdown(["", "presage", "best particle filter", "scan matcher", "bound (RMS)"], lines)


def accuracy(folder: Path) -> str:
    """The accuracy benchmark: presage, the tuned particle filter, its best variant in each task, and a scan matcher."""
    rows = read(folder / "accuracy.json")["rows"]
    best = {task: _best_filter([row for row in rows if row["task"] == task]) for task in {row["task"] for row in rows}}
    shown = ("precise", "particle-filter", "correlative")
    return report.table([row for row in rows if row["estimator"] in shown or row is best[row["task"]]])


def _best_filter(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The particle filter with the most poses found, less the wrong ones; of several, the most exact one."""
    filters = [row for row in rows if row["estimator"].startswith("particle-filter")]
    return max(
        filters,
        key=lambda row: (row["found"] - row["tracking_but_wrong"], -(row["position_error_rms_m"] or float("inf"))),
    )


def _integrity(row: dict[str, Any]) -> str:
    tracking, wrong = (100 * row[name]["count"] / row[name]["of"] for name in ("tracking", "wrong"))
    drives = f"{row['trials_wrong_longer']} of {row['trials']} drives"
    return f"{tracking:.1f} % `tracking`, of which {wrong:.2g} % wrong; for more than 1 s in {drives}"


def measured_by(folder: Path) -> str:
    """The version of presage and the seed of each stored result; peers' results are from elsewhere."""
    lines = []
    for path in sorted(folder.glob("*.json")):
        result = read(path)
        if "commit" in result:
            lines.append([f"[{path.stem}]({folder.name}/{path.name})", result["commit"], str(result.get("seed", "–"))])
    return markdown(["result", "commit", "seed"], lines)


TABLES = {
    "measured-by": measured_by,
    "readme-real": real_logs,
    "readme-simulation": simulation,
    "accuracy": accuracy,
    "peers": table_with_others,
}
