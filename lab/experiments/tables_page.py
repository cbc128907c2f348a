"""Fills the tables of experiments.md, navigation.md and real_logs.md in docs/ from the JSON."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from common.errors import UserError
from lab.experiments import results

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
    """Table and notes of a result in ``folder``, named "e1" or "converged/e1", for example."""
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
