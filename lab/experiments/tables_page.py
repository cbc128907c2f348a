"""Fills the tables of experiments.md, navigation.md and real_logs.md in docs/ from the JSON."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from common.errors import UserError
from lab.experiments import results
from lab.experiments.estimators import TEN_STEPS
from lab.experiments.results import mean_std, number

# Modules of the experiments. Each has a function `table`.
MODULES = {
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
TABLE_MARKS = re.compile(r"(<!-- table (?P<name>[\w/.-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
Summary = dict[str, dict[str, Any]]


def table_of(name: str, folder: Path) -> str:
    """Table and notes of a result in ``folder``, named "e1" or "converged/e1", for example; or "overview"."""
    if name == "overview":
        return overview(folder)
    kind = name.rsplit("/", maxsplit=1)[-1].partition("-")[0]  # navigation-unknown belongs to navigation
    if kind not in MODULES:
        raise UserError(f"no experiment {kind!r}: choose from {', '.join(MODULES)}")
    table: Callable[[Summary], str] = import_module(MODULES[kind]).table
    result = results.read(folder / f"{name}.json")
    return "\n\n".join([table(result["summary"]), *(f"{note[0].upper()}{note[1:]}" for note in result["notes"])])


def fill_tables(page: str, folder: Path) -> str:
    """Returns the page with every marked table replaced by the current results, without the notes below it."""

    def rows(name: str) -> str:
        return "".join(f"{line}\n" for line in table_of(name, folder).splitlines() if line.startswith("|"))

    return TABLE_MARKS.sub(lambda m: f"{m[1]}{rows(m['name'])}{m[3]}", page)


def overview(folder: Path) -> str:
    """Table that compares the paper, presets paper and precise, the particle filter and the Cramér-Rao bound."""
    e1, e2, e3 = (results.read(folder / f"{name}.json") for name in ("e1", "e2", "e3"))
    names = ("paper", "precise", "particle-filter")
    heads = ("", "Burghardt & Lanillos", "paper", "precise", "particle filter, tuned", "bound")
    one, two = (e1["summary"], e2["summary"])
    rows = [
        ["E1: error after 50 iterations (m)", "0.17 to 0.37 median, from its weights"]
        + [mean_std(one[name], "final_error", 4) for name in names] + [""],
        ["E1: RMS (mm)", "–"]
        + [results.millimetres(one[name]["final_error_rms_m"]) for name in names]
        + [results.millimetres(e1["parameters"]["bound_end_m"])],
        ["E1: within 0.5 m", "–"]
        + [f"{one[name]['found_within_0.5_m']}/{one[name]['trials']}" for name in names] + [""],
        ["E2: error on the way (m)", "figure only", *(mean_std(two[name], "error", 4) for name in names), ""],
        ["E2: RMS (mm)", "–"]
        + [results.millimetres(two[name]["error_rms_m"]) for name in names]
        + [results.millimetres(e2["parameters"]["bound, one scan, rms_m"])],
        *_navigation(e3["summary"], names),
    ]  # fmt: skip
    return results.markdown(heads, rows)


def _navigation(summary: Summary, names: tuple[str, ...]) -> list[list[str]]:
    # As a service, preset paper takes ten gradient steps per scan.
    own = [summary[name if name in summary else f"{name}, {TEN_STEPS}"] for name in names]
    return [
        ["E3: reached", "–", *(f"{r['reached']}/{r['trials']}" for r in own), ""],
        ["E3: trials with contact", "–", *(str(r["trials_with_contact"]) for r in own), ""],
        ["E3: iterations, mean", "12.5 of about 1 m", *(number(r["iterations_mean"], 1) for r in own), ""],
        ["E3: time / least, median", "–", *(number(r["time_over_least_median"], 3) for r in own), "1"],
    ]
