"""Writes an experiment's JSON, CSV and figure."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from common.errors import UserError
from common.geometry.se2 import Array
from common.versions import commit, presage_command, versions


@dataclass
class Result:
    """Outcome of an experiment; all values can be written as JSON."""

    name: str  # e1
    title: str
    seed: int
    parameters: dict[str, Any]
    summary: dict[str, dict[str, Any]]  # by what is compared, such as the estimator
    curves: dict[str, list[Any]] = field(default_factory=dict)  # columns of equal length
    trials: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def write(self, out: Path, figure: Figure | None) -> list[Path]:
        """Writes the result into the folder ``out``. Returns the paths of the files."""
        provenance = {"command": presage_command(), "commit": commit(), "versions": versions()}
        path = out / f"{self.name}.json"
        if figure is not None:  # before the JSON file, which marks a result as complete
            for suffix in (".pdf", ".png"):
                # Without a creation date the file depends on the data alone.
                metadata = {"CreationDate": None} if suffix == ".pdf" else None
                figure.savefig(out / (self.name + suffix), dpi=150, metadata=metadata)
        own = {name: value for name, value in vars(self).items() if name not in ("trials", "curves")}
        path.write_text(json.dumps({**own, **provenance}, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        files = [path]
        if self.trials:
            files.append(out / f"{self.name}.trials.jsonl")
            files[-1].write_text("".join(json.dumps(each) + "\n" for each in self.trials), encoding="utf-8")
        if self.curves:
            files.append(out / f"{self.name}.csv")
            with files[-1].open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(self.curves)
                writer.writerows(zip(*self.curves.values(), strict=True))
        if figure is not None:
            files += [out / (self.name + suffix) for suffix in (".pdf", ".png")]
        return files


def read(path: Path) -> dict[str, Any]:
    """Reads a result's JSON. Raises UserError if it does not exist or is malformed."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        name = path.stem.split("-")[0]
        raise UserError(
            f"{path}: no such result; create it with `presage experiment {name}` or `presage bench {name}` (the target "
            "`tables` of the Makefile has the command of each result)"
        ) from None
    except ValueError as error:
        raise UserError(f"{path}: not a result of `presage experiment` ({error})") from None


def spread(rows: Sequence[Sequence[float]] | Array) -> tuple[list[float], list[float]]:
    """Mean and standard deviation over N trials at each of K times, of values (N, K)."""
    values = np.asarray(rows, float)
    return values.mean(axis=0).tolist(), values.std(axis=0).tolist()


def curves_of(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, list[Any]]:
    """CSV columns: mean and standard deviation over trials of each estimator's error_m, at each time."""
    curves: dict[str, list[Any]] = {}
    for name in names:
        curves[f"{name} mean m"], curves[f"{name} std m"] = spread([row["error_m"][name] for row in rows])
    return curves


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def number(value: float | None, digits: int = 3) -> str:
    """Formats a number for a table; a dash for None and non-finite values."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def millimetres(metres: float | None) -> str:
    """Formats a length as millimetres for a table, with about three digits: 0.35, 12.3, 1757."""
    if metres is None or not np.isfinite(metres):
        return "–"
    value = 1000 * metres
    return f"{value:.{2 if value < 10 else 1 if value < 100 else 0}f}"


def ratio(value: float) -> str:
    """Formats a ratio for a table: 1.1, 23, 5494."""
    return f"{value:.{1 if value < 10 else 0}f}"


def mean_std(summary: Mapping[str, Any], quantity: str) -> str:
    """Formats the summary's QUANTITY_mean_m and QUANTITY_std_m as mean ± standard deviation."""
    mean, std = summary.get(f"{quantity}_mean_m"), summary.get(f"{quantity}_std_m")
    return f"{number(mean, 4)} ± {number(std, 4)}"
