"""`presage bench integrity`: tables, JSON and reliability diagram."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from common.errors import UserError
from lab.experiments.results import Result, markdown, millimetres, number
from lab.integrity.cases import CASES
from lab.integrity.runner import IntegrityPlan, run
from lab.integrity.scoring import MAX_WRONG_S, RECOVERY_SCANS
from presage.plotting.style import BOUND, COLOURS, GOAL, figure_of, legend_below
from presage.terminal.output import make_folder

ESTIMATORS = ("precise", "particle-filter", "amcl-defaults")
HEADS = (
    "case",
    "estimator",
    "trials",
    "tracking",
    "wrong of these",
    "longest (s)",
    f"trials > {MAX_WRONG_S:g} s",
    "correct",
    "NEES x, y: mean; median",
    "NEES",
    "error median/RMS (mm)",
    f"found in {RECOVERY_SCANS} scans",
    "beyond protection",
    "update median/95 %/max (ms)",
)
LEGEND = """*Tracking*: scans reported as `tracking`. *Wrong*: of these, scans with an error above 0.2 m or 5°, with
Wilson's 95 % interval (too narrow, because scans of one trial depend on each other). *Longest*: wrong stretch; *trials*
with one of more than a second. *Correct*: scans within 0.2 m and 5°, in any state. *NEES* where `tracking`; 2 and 3 are
ideal. *Error* of correct scans. *Found*: `tracking` at the right place after a kidnapping. *Beyond protection*: shares
of scans whose error along x, along y and in yaw exceeds the protection level."""


def bench_integrity(plan: IntegrityPlan, out: Path, workers: int, console: Console) -> int:
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
    return 0


def _check(plan: IntegrityPlan) -> None:
    """Raises UserError for unknown names."""
    for kind, given, known in (
        ("case", plan.cases, CASES),
        ("estimator", plan.estimators, ESTIMATORS),
        ("model", (plan.model,), ("learned", "exact")),
    ):
        if unknown := [name for name in given if name not in known]:
            raise UserError(f"no {kind} {unknown[0]!r} in this benchmark: choose from {', '.join(known)}")


def table(scores: dict[str, dict[str, Any]]) -> str:
    """The Markdown table, with a row for each case and estimator."""
    cases = list(dict.fromkeys(case for by_case in scores.values() for case in by_case))
    cases = cases[:1] if cases[1:] == ["all"] else cases
    return markdown(
        HEADS,
        [[case, name, *_cells(by_case[case])] for case in cases for name, by_case in scores.items() if case in by_case],
    )


def _cells(row: dict[str, Any]) -> list[str]:
    beyond = row["beyond_protection"]
    return [
        str(row["trials"]),
        _percent(row["tracking"]),
        _percent(row["wrong"], interval=True),
        f"{row['longest_wrong_s']:.1f}",
        str(row["trials_wrong_longer"]),
        _percent(row["correct"]),
        f"{_short(row['nees_xy'])}; {_short(row['nees_xy_median'])}",
        _short(row["nees"]),
        f"{millimetres(row['error_median_m'])}/{millimetres(row['error_rms_m'])}",
        "" if row["recovered"] is None else f"{row['recovered']['count']}/{row['recovered']['of']}",
        "" if beyond[0] is None else ", ".join(f"{share:.2g}" for share in beyond),
        "/".join(f"{value:.1f}" for value in row["update_ms"]),
    ]


def _percent(share: dict[str, Any] | None, *, interval: bool = False) -> str:
    if share is None:
        return "–"
    text = f"{100 * share['count'] / share['of']:.4g} %"
    low, high = (100 * bound for bound in share["interval_95"])
    return f"{text} ({low:.3g} to {high:.3g})" if interval else text


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
