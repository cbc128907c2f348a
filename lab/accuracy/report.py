"""`presage bench accuracy`: table, JSON and figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.ticker import LogLocator
from rich.console import Console
from rich.table import Table

from common.errors import UserError
from common.geometry.world import load_world
from common.robot.scanner import Scanner
from common.robot.scanner_options import build_scanner
from lab.accuracy.compared_estimators import COMPARED_ESTIMATORS
from lab.accuracy.runner import TASKS, AccuracyJob, run_all
from lab.accuracy.tasks import FOUND_DISTANCE, FOUND_YAW, TWINS_REQUIRED_FROM_SCAN
from presage.plotting.style import empty_figure
from presage.terminal.output import check_file, provenance, write_json

# Colour (colour-blind safe, Okabe & Ito) and marker of each estimator in the figure.
MARKS = {
    "precise": ("#0072B2", "o"),
    "precise-exact": ("#56B4E9", "s"),
    "particle-filter": ("#D55E00", "^"),
    "amcl-defaults": ("#CC79A7", "v"),
    "particle-filter-all-beams": ("#009E73", "D"),
    "particle-filter-no-recovery": ("#E69F00", "<"),
    "particle-filter-learned-field": ("#999999", "X"),
    "particle-filter-beam-model": ("#000000", "*"),
    "particle-filter-scan-matching": ("#56B4E9", "P"),
    "correlative": ("#D55E00", "d"),
}
FEW_FOUND = 0.9  # the mark of an estimator that found a smaller share of a task's poses is pale
# Printed below each --markdown table.
LEGEND = f"""Errors are of the position, in mm. *Found*: trials within {FOUND_DISTANCE:g} m and
{np.rad2deg(FOUND_YAW):g}° of the true pose, with Wilson's 95 % interval, where trials are independent; median, RMS and
NEES are of these, with bootstrap intervals over trials, or over 5 s of a path. *Wrong*: trials that published
`tracking` elsewhere. A NEES of 3 means a consistent covariance. The bound is the Cramér-Rao bound, RMS. "Both kept":
from scan {TWINS_REQUIRED_FROM_SCAN} until a scan distinguishes the two rooms, every belief contains a hypothesis at the
true pose and one at its twin; wrong counts trials that published `tracking` at the wrong place during that time."""
HEADS = ("estimator", "found (95 %)", "wrong", "median", "RMS (95 %)", "NEES", "update (ms)")


def bench_accuracy(
    worlds: str,
    estimators: str,
    tasks: str,
    trials: int,
    minutes: float,
    seed: int,
    seeds: int,
    workers: int,
    json_file: Path | None,
    figure: Path | None,
    console: Console,
    *,
    markdown: bool = False,
    scanner: str = "tim571",
) -> None:
    """Runs the benchmark, prints a table per world and scanner, and writes ``json_file`` and ``figure`` if given.

    Each of ``seeds`` consecutive seeds has its own places, noise and paths; the rows are over all of them.
    """
    chosen = list(COMPARED_ESTIMATORS) if estimators == "all" else estimators.split(",")
    unknown = [name for name in chosen if name not in COMPARED_ESTIMATORS]
    if unknown:
        raise UserError(f"no estimator {unknown[0]!r} in this benchmark: choose from {', '.join(COMPARED_ESTIMATORS)}")
    scanners = scanners_of(scanner)
    wanted = tuple(tasks.split(",")) if tasks else TASKS
    if missing := [name for name in wanted if name not in TASKS]:
        raise UserError(f"no task {missing[0]!r}: choose from {', '.join(TASKS)}")
    names = worlds.split(",")
    for name in names:
        load_world(name)
    check_file(json_file, "--json")
    check_file(figure, "--figure")
    jobs = [
        AccuracyJob(estimator, world, each, trials, minutes * 60, own_seed, wanted)
        for world in names
        for each in scanners
        for estimator in chosen
        for own_seed in range(seed, seed + seeds)
    ]
    rows = run_all(jobs, workers, console)
    if markdown:
        print(table(rows), LEGEND, sep="\n\n")
    else:
        for title, own in _by_title(rows).items():
            console.print(_table(own, title))
    write_json(json_file, {"rows": rows, "trials": trials, "minutes": minutes, "seeds": seeds, **provenance(seed)})
    if figure is not None:
        _draw(rows, figure)


def scanners_of(names: str) -> list[Scanner]:
    """The scanners of comma-separated names or files; tim571 has 622 beams, as in the paper.

    Raises UserError for unknown names.
    """
    return [build_scanner(name, 622 if name == "tim571" else None) for name in names.split(",")]


def _by_title(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        scanner = "" if row["scanner"] == "tim571" else f"{row['scanner']}, "
        groups.setdefault(f"{row['world']}, {scanner}{row['beams']} beams", []).append(row)
    return groups


def _number(value: float | None, scale: float = 1.0, digits: int = 2) -> str:
    return "" if value is None else f"{value * scale:.{digits}f}"


def _table(rows: list[dict[str, Any]], title: str) -> Table:
    table = Table(
        title=f"{title}; errors and NEES: only of trials found; wrong: reported `tracking` at a wrong pose",
        title_justify="left",
    )
    heads = "task|estimator|found|wrong|median mm|RMS mm|95 % mm|yaw deg|bound mm|RMS/bound|NEES|band|update ms"
    for column in heads.split("|"):
        table.add_column(column, justify="left" if column in ("task", "estimator") else "right")
    for row in sorted(rows, key=lambda r: [q["task"] for q in rows].index(r["task"])):
        band = row["nees_band"]
        table.add_row(
            row["task"],
            row["estimator"],
            f"{row['found']}/{row['of']}",
            str(row["tracking_but_wrong"]),
            _number(row["position_error_median_m"], 1e3),
            _number(row["position_error_rms_m"], 1e3),
            _number(row["position_error_p95_m"], 1e3),
            _number(row["heading_error_median_deg"], 1, 3),
            _number(row["bound_rms_m"], 1e3),
            _number(row["rms_over_bound"]),
            _number(row["nees_mean"]),
            "" if band is None else f"{band[0]:.2f}-{band[1]:.2f}",
            _number(row["update_ms_median"], 1, 1),
        )
    return table


def table(rows: list[dict[str, Any]]) -> str:
    """A Markdown table for each world and scanner."""
    return "\n\n".join(_markdown(own, title) for title, own in _by_title(rows).items())


def _markdown(rows: list[dict[str, Any]], title: str) -> str:
    """A Markdown table with one line for each task and estimator; `LEGEND` explains the columns."""
    lines = ["| " + " | ".join((title, *HEADS)) + " |", "|" + "---|" * (len(HEADS) + 1)]
    for task in dict.fromkeys(row["task"] for row in rows):
        own = [row for row in rows if row["task"] == task]
        limit = next((row["bound_rms_m"] for row in own if row["bound_rms_m"] is not None), None)
        bound = "" if limit is None else f" (bound {_number(limit, 1e3)})"
        lines += [f"| {task}{bound} | " + " | ".join(_cells(row)) + " |" for row in own]
    return "\n".join(lines)


def _cells(row: dict[str, Any]) -> list[str]:
    return [
        row["estimator"],
        _found(row),
        str(row["tracking_but_wrong"]),
        _number(row["position_error_median_m"], 1e3),
        f"{_number(row['position_error_rms_m'], 1e3)}{_interval(row['position_error_rms_95_m'])}",
        _number(row["nees_mean"]),
        _number(row["update_ms_median"], 1, 1),
    ]


def _found(row: dict[str, Any]) -> str:
    share = row["found_share_95"]
    interval = "" if share is None else f" ({100 * share[0]:.0f} to {100 * share[1]:.0f} %)"
    return f"{row['found']}/{row['of']}{interval}"


def _interval(bounds: list[float] | None) -> str:
    return "" if bounds is None else f" ({_number(bounds[0], 1e3)} to {_number(bounds[1], 1e3)})"


def cell(row: dict[str, Any]) -> str:
    """Errors and counts of one task, for the Markdown table of README; `LEGEND` explains them."""
    counts = f"{row['found']}/{row['of']}, {row['tracking_but_wrong']} wrong"
    if row["position_error_median_m"] is None:
        return counts
    errors = "/".join(_number(row[f"position_error_{name}_m"], 1e3) for name in ("median", "rms"))
    return f"{errors} mm; {counts}"


def _draw(rows: list[dict[str, Any]], file: Path) -> None:
    """Figure of the RMS position error of each task, with the Cramér-Rao bound as a vertical bar."""
    title, rows = next(iter(_by_title(rows).items()))
    rows = [row for row in rows if row["position_error_rms_m"] is not None]
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure = empty_figure(9, 0.55 * len(tasks) + 2)
    axes = figure.add_subplot()
    for name in dict.fromkeys(row["estimator"] for row in rows):
        own = [row for row in rows if row["estimator"] == name]
        _draw_estimator(axes, own, tasks, name)
    bounds = list({row["task"]: row for row in reversed(rows) if row["bound_rms_m"] is not None}.values())
    axes.scatter(
        [row["bound_rms_m"] * 1e3 for row in bounds],
        [tasks.index(row["task"]) for row in bounds],
        color="black",
        marker="|",
        s=300,
        label="Cramér-Rao bound",
        zorder=4,
    )
    axes.set_yticks(np.arange(len(tasks)), tasks)
    axes.invert_yaxis()
    axes.set(
        xscale="log",
        xlabel="position error, RMS (mm)",
        title=f"{title}; pale: less than {FEW_FOUND:.0%} of the poses found",
    )
    axes.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.grid(alpha=0.3, which="both", axis="x")
    figure.legend(loc="outside lower center", ncols=4, fontsize=8)
    figure.savefig(file, dpi=150)


def _draw_estimator(axes: Axes, rows: list[dict[str, Any]], tasks: list[str], name: str) -> None:
    """Draws one estimator's errors."""
    colour, mark = MARKS[name]
    errors_mm = [row["position_error_rms_m"] * 1e3 for row in rows]
    lines = [tasks.index(row["task"]) for row in rows]
    colours = [to_rgba(colour, 1.0 if row["found"] >= FEW_FOUND * row["of"] else 0.25) for row in rows]
    axes.scatter(errors_mm, lines, color=colours, marker=mark, s=50, zorder=3)
    axes.scatter([], [], color=colour, marker=mark, s=50, label=name)
