"""Fills the tables of README and the pages in docs/ from the JSON of the experiments."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from common.errors import UserError
from lab.experiments import results
from lab.pages.joint_tables import TABLES

# Modules of the experiments. Each has a function `table`.
MODULES = {
    "accuracy": "lab.accuracy.report",
    "e1": "lab.paper.e1_localisation",
    "e2": "lab.paper.e2_crossing",
    "e3": "lab.paper.e3_navigation",
    "alpha": "lab.paper.alpha_sweep",
    "steps": "lab.paper.step_sizes",
    "samples": "lab.paper.samples",
    "aliasing": "lab.paper.aliasing",
    "prediction": "lab.paper.prediction",
    "navigation": "lab.navigation.experiment",
    "docking": "lab.navigation.docking",
    "exploration": "lab.exploration.experiment",
    "real": "lab.real_logs.experiment",
    "integrity": "lab.integrity.report",
    "peers": "lab.peers.experiment",
    "refinement": "lab.benchmarks.refinement",
    "visits": "lab.benchmarks.visits",
    "mapping-faults": "lab.benchmarks.mapping_faults",
    "live-refinement": "lab.benchmarks.live_refinement",
    "live-changes": "lab.benchmarks.live_changes",
    "area": "lab.benchmarks.area",
    "training": "lab.benchmarks.training",
}
# Results with and without the terms of information, in one table.
COMPARED = {
    "hall": (
        "navigation-hall-holonomic-odometry-slip0.05-beams271-range4",
        "navigation-hall-holonomic-odometry-no-epistemic-slip0.05-beams271-range4",
    ),
    "twins": ("navigation-twins-unknown", "navigation-twins-unknown-no-epistemic"),
    "look-alike": ("navigation-look-alike-unknown", "navigation-look-alike-unknown-no-epistemic"),
}
TABLE_MARKS = re.compile(r"(<!-- table (?P<name>[\w/.-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def table_of(name: str, folder: Path) -> str:
    """Table and notes of a result in ``folder``, named "e1" or "converged/e1", for example."""
    kind = name.rsplit("/", maxsplit=1)[-1]
    if kind not in MODULES:
        kind = kind.partition("-")[0]  # navigation-unknown belongs to navigation
    if kind not in MODULES:
        raise UserError(f"no experiment {kind!r}: choose from {', '.join(MODULES)}")
    table: Callable[[Any], str] = import_module(MODULES[kind]).table
    result = results.read(folder / f"{name}.json")
    if "rows" in result:  # of a benchmark
        return table(result["rows"])
    return "\n\n".join([table(result["summary"]), *(f"{note[0].upper()}{note[1:]}" for note in result["notes"])])


def comparison(name: str, folder: Path) -> str:
    """Table of the two results of `COMPARED`."""
    summary = {
        f"{group}, {arm}": row
        for arm, result in zip(("with", "without"), COMPARED[name], strict=True)
        for group, row in results.read(folder / f"{result}.json")["summary"].items()
    }
    table: Callable[[Any], str] = import_module(MODULES["navigation"]).table
    return table(dict(sorted(summary.items())))


def fill_tables(page: str, folder: Path) -> str:
    """Returns the page with every marked table replaced by the current results, without the notes below it."""

    def rows(name: str) -> str:
        if name in COMPARED:
            table = comparison(name, folder)
        else:
            table = TABLES[name](folder) if name in TABLES else table_of(name, folder)
        lines = [line for line in table.splitlines() if line.startswith("|") or not line]
        return "\n".join(lines).strip() + "\n"

    return TABLE_MARKS.sub(lambda m: f"{m[1]}{rows(m['name'])}{m[3]}", page)
