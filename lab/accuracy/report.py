"""`presage bench accuracy`: table, JSON and figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from rich.console import Console
from rich.table import Table

from common.errors import UserError
from common.geometry.world import load_world
from common.robot.scanner import Scanner
from common.robot.scanner_options import chosen_scanner
from lab.accuracy.runner import CHOICES, TASKS, Job, about, run_all
from lab.accuracy.tasks import FOUND_DISTANCE, FOUND_YAW, TWINS_FROM
from presage.terminal.output import check_file, write_json

# Colours and marks that the colour-blind can tell apart (Okabe & Ito), and where words stand: points above the mark.
MARKS = {
    "precise": ("#0072B2", "o", 7), "precise-exact": ("#56B4E9", "s", -14), "particle-filter": ("#D55E00", "^", 7),
    "amcl-defaults": ("#CC79A7", "v", -14),
}  # fmt: skip
# Below each table of --markdown: the errors alone would hide the trials that failed.
LEGEND = f"""Position error median / RMS; found of all (within {FOUND_DISTANCE:g} m and {np.rad2deg(FOUND_YAW):g}°);
wrong: how many of all published `tracking` while the robot was elsewhere; NEES, 3 is honest. Errors and NEES are of
those found alone. The bound is Cramér-Rao's, RMS in mm. Both kept: from scan {TWINS_FROM} on, until a scan tells the
rooms apart, every belief has a hypothesis at the true pose and one at its twin; wrong there: trials with such a claim
meanwhile."""


def bench_accuracy(
    worlds: str, beams: str, estimators: str, tasks: str, trials: int, minutes: float, seed: int,
    workers: int, json_file: Path | None, figure: Path | None, console: Console, *, markdown: bool = False,
    scanner: str = "tim571",
) -> int:  # fmt: skip
    """Measure, print, and write where asked."""
    chosen = estimators.split(",")
    unknown = [name for name in chosen if name not in CHOICES]
    if unknown:
        raise UserError(f"no estimator {unknown[0]!r}: choose from {', '.join(CHOICES)}")
    scanners = scanners_of(scanner, beams)
    wanted = tuple(tasks.split(",")) if tasks else TASKS
    if missing := [name for name in wanted if name not in TASKS]:
        raise UserError(f"no task {missing[0]!r}: choose from {', '.join(TASKS)}")
    names = worlds.split(",")
    for name in names:
        load_world(name)
    check_file(json_file, "--json")
    check_file(figure, "--figure")
    jobs = [
        Job(estimator, world, each, trials, minutes * 60, seed, wanted)
        for world in names for each in scanners for estimator in chosen
    ]  # fmt: skip
    rows = run_all(jobs, workers, console)
    for title, own in _by_title(rows).items():
        if markdown:
            print(_markdown(own, title))
            print(LEGEND)
        else:
            console.print(_table(own, title))
    write_json(json_file, {"rows": rows, "trials": trials, "minutes": minutes, **about(seed)})
    if figure is not None:
        _draw(rows, figure)
    return 0


def scanners_of(names: str, beams: str) -> list[Scanner]:
    """Each scanner with each number of beams; none: its own, of tim571 the paper's 622. Raises UserError."""
    try:
        counts = [int(part) for part in beams.split(",") if part]
    except ValueError:
        raise UserError(f"--beams {beams!r}: give numbers, such as 622,811") from None
    found = []
    for name in names.split(","):
        own: list[int | None] = [*counts] or [622 if name == "tim571" else None]
        found += [chosen_scanner(name, count) for count in own]
    return found


def _by_title(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        scanner = "" if row["scanner"] == "tim571" else f"{row['scanner']}, "
        found.setdefault(f"{row['world']}, {scanner}{row['beams']} beams", []).append(row)
    return found


def _number(value: float | None, scale: float = 1.0, digits: int = 2) -> str:
    return "" if value is None else f"{value * scale:.{digits}f}"


def _table(rows: list[dict[str, Any]], title: str) -> Table:
    table = Table(
        title=f"{title}; errors and NEES of the found alone; wrong: `tracking` elsewhere", title_justify="left"
    )
    heads = "task|estimator|found|wrong|median mm|RMS mm|95 % mm|yaw deg|bound mm|RMS/bound|NEES|band|update ms"
    for column in heads.split("|"):
        table.add_column(column, justify="left" if column in ("task", "estimator") else "right")
    for row in sorted(rows, key=lambda r: [q["task"] for q in rows].index(r["task"])):
        band = row["nees_band"]
        table.add_row(
            row["task"], row["estimator"], f"{row['found']}/{row['of']}", str(row["tracking_but_wrong"]),
            _number(row["position_error_median_m"], 1e3), _number(row["position_error_rms_m"], 1e3),
            _number(row["position_error_p95_m"], 1e3), _number(row["heading_error_median_deg"], 1, 3),
            _number(row["bound_rms_m"], 1e3), _number(row["rms_over_bound"]), _number(row["nees_mean"]),
            "" if band is None else f"{band[0]:.2f}-{band[1]:.2f}", _number(row["update_ms_median"], 1, 1),
        )  # fmt: skip
    return table


def _markdown(rows: list[dict[str, Any]], title: str) -> str:
    """A line for each task; `LEGEND` says what the cells hold."""
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    lines = [f"| {title} | " + " | ".join(names) + " | bound |", "|---" * (len(names) + 2) + "|"]
    for task in dict.fromkeys(row["task"] for row in rows):
        own = {row["estimator"]: row for row in rows if row["task"] == task}
        limit = next((row["bound_rms_m"] for row in own.values() if row["bound_rms_m"] is not None), None)
        cells = [_cell(own[name]) if name in own else "" for name in names]
        lines.append(f"| {task} | " + " | ".join(cells) + f" | {_number(limit, 1e3)} |")
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any]) -> str:
    counts = f"{row['found']}/{row['of']}, {row['tracking_but_wrong']} wrong"
    if row["position_error_median_m"] is None:
        return counts
    error = f"{_number(row['position_error_median_m'], 1e3)} / {_number(row['position_error_rms_m'], 1e3)} mm"
    nees = f", NEES {row['nees_mean']:.2f}" if row["nees_mean"] is not None else ""
    return f"{error}, {counts}{nees}"


def _draw(rows: list[dict[str, Any]], file: Path) -> None:
    """Root mean square position error of each task; the bound as a bar beside."""
    title, rows = next(iter(_by_title(rows).items()))
    rows = [row for row in rows if row["position_error_rms_m"] is not None]
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure = Figure(figsize=(9, 0.55 * len(tasks) + 2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name in dict.fromkeys(row["estimator"] for row in rows):
        own = [row for row in rows if row["estimator"] == name]
        colour, mark, above = MARKS[name]
        axes.scatter(
            [row["position_error_rms_m"] * 1e3 for row in own], [tasks.index(row["task"]) for row in own],
            color=colour, marker=mark, s=50, label=name, zorder=3,
        )  # fmt: skip
        for row in own:
            if row["found"] < row["of"]:
                axes.annotate(
                    f"{row['found']}/{row['of']}", (row["position_error_rms_m"] * 1e3, tasks.index(row["task"])),
                    textcoords="offset points", xytext=(0, above), ha="center", fontsize=7, color=colour,
                )  # fmt: skip
    bounds = [row for row in rows if row["bound_rms_m"] is not None]
    axes.scatter(
        [row["bound_rms_m"] * 1e3 for row in bounds], [tasks.index(row["task"]) for row in bounds],
        color="black", marker="|", s=300, label="Cramér-Rao bound", zorder=4,
    )  # fmt: skip
    axes.set_yticks(np.arange(len(tasks)), tasks)
    axes.invert_yaxis()
    axes.set(
        xscale="log", xlabel="position error, RMS (mm)",
        title=f"{title}; numbers: found of all, where not all",
    )  # fmt: skip
    axes.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.grid(alpha=0.3, which="both", axis="x")
    figure.legend(loc="outside lower center", ncols=len(MARKS) + 1)
    figure.savefig(file, dpi=150)
