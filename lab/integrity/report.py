"""`presage bench integrity`: tables, JSON and reliability diagram."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from common.errors import UserError
from lab.experiments.results import Result, markdown, millimetres, number
from lab.integrity.cases import CASES
from lab.integrity.runner import RECOVERING_FILTER, IntegrityPlan, run
from presage.plotting.style import BOUND, COLOURS, GOAL, figure_of, legend_below
from presage.terminal.output import make_folder

ESTIMATORS = ("precise", "particle-filter", RECOVERING_FILTER, "amcl-defaults")
HEADS = ("`tracking` %", "wrong of these %; longest; in drives", "correct %", "error (mm)", "NEES")  # of each estimator
SHORT_COLUMNS = 3  # of these, in a table of more than two estimators
LEGEND = """*Tracking*: share of the scans that are reported as `tracking`. *Wrong*: share of these with an error above
0.2 m or 5°; the longest wrong stretch; the number of drives with a wrong scan. *Correct*: scans within 0.2 m and 5°,
in any state. *Error*: median/RMS of correct scans. *NEES*: mean of x, y and heading where `tracking`; 3 is ideal. The
JSON has intervals and more."""


def bench_integrity(plan: IntegrityPlan, out: Path, workers: int, console: Console) -> None:
    """Runs the benchmark, prints a Markdown table, and writes the results into ``out``."""
    _check(plan)
    make_folder(out)
    scores, rows = run(plan, out, workers, console)
    parameters = asdict(plan)
    title = "Integrity: whether an estimator is right about itself"
    result = Result("integrity", title, plan.seed, parameters, scores, trials=rows, notes=[" ".join(LEGEND.split())])
    text = f"{table(scores)}\n\n{LEGEND}\n"
    (out / "integrity.md").write_text(text, encoding="utf-8")
    files = result.write(out, reliability_diagram(scores))
    print(text)
    console.print(*[out / "integrity.md", *files], sep="\n")


def _check(plan: IntegrityPlan) -> None:
    """Raises UserError for unknown or repeated names, or if there is nothing to measure."""
    for kind, given, known in (
        ("case", plan.cases, CASES),
        ("estimator", plan.estimators, ESTIMATORS),
        ("model", (plan.model,), ("learned", "exact")),
    ):
        if unknown := [name for name in given if name not in known]:
            raise UserError(f"no {kind} {unknown[0]!r} in this benchmark: choose from {', '.join(known)}")
    logs = [log.name for log in plan.logs]
    for kind, names in (("case", plan.cases), ("estimator", plan.estimators), ("log of the name", logs)):
        if repeated := [name for name, count in Counter(names).items() if count > 1]:
            raise UserError(f"the {kind} {repeated[0]!r} is given twice: its scans would count twice")
    if not plan.sources() or not plan.estimators:
        raise UserError("nothing to measure: give at least one world or log, one case and one estimator")


def table(scores: dict[str, dict[str, Any]]) -> str:
    """The Markdown table, with a row for each case and columns for each estimator.

    With more than two estimators, it would be too wide: then only the first has all columns of `HEADS`.
    """
    cases = list(dict.fromkeys(case for by_case in scores.values() for case in by_case))
    if set(cases[1:]) <= {"all", "all with a correct map"}:
        cases = cases[:1]  # with a single case, the others are the same trials again
    columns = dict.fromkeys(scores, len(HEADS))
    if len(scores) > 2:
        columns |= dict.fromkeys([*scores][1:], SHORT_COLUMNS)
    heads = [f"{name}: {HEADS[0]}" if k == 0 else HEADS[k] for name, count in columns.items() for k in range(count)]
    rows = [
        [case, *(cell for name, count in columns.items() for cell in _cells(scores[name].get(case))[:count])]
        for case in cases
    ]
    return markdown(["case", *heads], rows)


def _cells(row: dict[str, Any] | None) -> list[str]:
    if row is None:
        return [""] * len(HEADS)
    return [
        _percent(row["tracking"]),
        _wrong(row),
        _percent(row["correct"]),
        "–"
        if row["error_rms_m"] is None
        else "/".join(millimetres(row[f"error_{name}_m"]) for name in ("median", "rms")),
        _short(row["nees"]),
    ]


def _percent(share: dict[str, Any] | None) -> str:
    return "–" if share is None else f"{100 * share['count'] / share['of']:.3g}"


def _wrong(row: dict[str, Any]) -> str:
    """Share of the `tracking` scans that are wrong, the longest wrong stretch, and in how many drives there is one."""
    wrong, drives = row["wrong"], row["trials_wrong"]
    if wrong is None or not wrong["count"]:
        return _percent(wrong)
    return f"{_percent(wrong)}; {row['longest_wrong_s']:.1f} s; {drives['count']} of {drives['of']}"


def _short(value: float | None) -> str:
    return number(value, 2) if value is None or value < 100 else f"{value:.3g}"


def reliability_diagram(scores: dict[str, dict[str, Any]]) -> Figure | None:
    """Observed share of correct scans against the reported probability; None if no estimator reports one.

    The axes show the probability of an error, so that small ones can be told apart.
    """
    reported = {name: bins for name, by_case in scores.items() if (bins := by_case["all"]["reliability"])}
    if not reported:
        return None
    figure, (axes,) = figure_of(width=5.0, height=4.6)
    lowest = 1.0
    for name, bins in reported.items():
        x = np.array([max(1 - each["reported"], 1e-6) for each in bins])
        bounds = 1 - np.array([each["correct"]["interval_95"] for each in bins])
        middle = 1 - np.array([each["correct"]["count"] / each["correct"]["of"] for each in bins])
        spread = np.abs(bounds - middle[:, None]).T[::-1]
        axes.errorbar(x, middle, spread, fmt="o-", capsize=3, color=COLOURS.get(name, GOAL), label=name)
        lowest = min(lowest, float(x.min()))
    axes.plot([lowest, 1], [lowest, 1], "--", color=BOUND, label="ideal")
    axes.set(xlabel="reported probability of an error", ylabel="observed share of errors")
    for axis in (axes.set_xscale, axes.set_yscale):
        axis("symlog", linthresh=1e-5)
    legend_below(figure, axes)
    return figure
