"""Fills the tables of docs/experiments.md from the JSON."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from common.errors import UserError
from lab.experiments import results
from lab.experiments.estimators import STEPS
from lab.experiments.results import mean_std, number

# Experiments in the order of the page, and the modules that run them.
MODULES = {  # imported by name, since they import the shared parts of this package
    "e1": "lab.paper.e1_localisation",
    "e2": "lab.paper.e2_crossing",
    "e3": "lab.paper.e3_navigation",
    "alpha": "lab.paper.alpha_sweep",
    "steps": "lab.paper.step_sizes",
    "samples": "lab.paper.samples",
    "aliasing": "lab.paper.aliasing",
    "prediction": "lab.paper.prediction",
    "navigation": "lab.navigation.experiment",
    "real": "lab.real_logs.experiment",
}
MARKED = re.compile(r"(<!-- table (?P<name>[\w/.-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
Summary = dict[str, dict[str, Any]]


def table_of(name: str, folder: Path) -> str:
    """The table and the notes of one result in ``folder``, or `overview` of several; e1, converged/e1."""
    if name == "overview":
        return overview(folder)
    kind = name.rsplit("/", maxsplit=1)[-1].partition("-")[0]  # navigation-unknown is one of navigation's
    if kind not in MODULES:
        raise UserError(f"no experiment {kind!r}: choose from {', '.join(MODULES)}")
    table: Callable[[Summary], str] = import_module(MODULES[kind]).table
    result = results.read(folder / f"{name}.json")
    return "\n\n".join([table(result["summary"]), *(f"{note[0].upper()}{note[1:]}" for note in result["notes"])])


def filled(page: str, folder: Path) -> str:
    """The page with each table between its marks as the results have it."""
    return MARKED.sub(lambda m: f"{m[1]}{table_of(m['name'], folder)}\n{m[3]}", page)


def overview(folder: Path) -> str:
    """The paper, its rebuild, preset precise, the particle filter and the bound, side by side."""
    e1, e2, e3 = (results.read(folder / f"{name}.json") for name in ("e1", "e2", "e3"))
    names = ("paper", "precise", "particle-filter")
    heads = ("", "Burghardt & Lanillos", "preset `paper`", "preset `precise`", "particle filter, tuned", "bound")
    one, two = (e1["summary"], e2["summary"])
    rows = [
        ["E1: error after 50 iterations (m)", "a figure; weights re-measured: 0.17 to 0.37 median"]
        + [mean_std(one[name], "final_error", 4) for name in names] + [""],
        ["E1: the same, RMS (mm)", "–"]
        + [results.millimetres(one[name]["final_error_rms_m"]) for name in names]
        + [results.millimetres(e1["parameters"]["bound_end_m"])],
        ["E1: places within 0.5 m", "–"]
        + [f"{one[name]['found_within_0.5_m']} of {one[name]['trials']}" for name in names] + [""],
        ["E2: error on the way (m)", "a figure", *(mean_std(two[name], "error", 4) for name in names), ""],
        ["E2: the same, RMS (mm)", "–"]
        + [results.millimetres(two[name]["error_rms_m"]) for name in names]
        + [results.millimetres(e2["parameters"]["bound, one scan, rms_m"])],
        *_navigation(e3["summary"], names),
    ]  # fmt: skip
    return results.markdown(heads, rows)


def _navigation(summary: Summary, names: tuple[str, ...]) -> list[list[str]]:
    # The running service makes ten gradient steps a scan.
    own = [summary[name if name in summary else f"{name}, {STEPS}"] for name in names]
    return [
        ["E3: reached", "–", *(f"{r['reached']} of {r['trials']}" for r in own), ""],
        ["E3: trials with a contact", "–", *(str(r["trials_with_contact"]) for r in own), ""],
        ["E3: iterations, mean", "12.5 (of about 1 m each)"] + [number(r["iterations_mean"], 1) for r in own] + [""],
        ["E3: time over the least possible, median", "–"]
        + [number(r["time_over_least_median"], 3) for r in own] + ["1"],
    ]  # fmt: skip
