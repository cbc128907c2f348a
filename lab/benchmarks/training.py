"""`presage bench training`: how much the errors of the shipped models depend on the seed of their training."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from common.errors import UserError
from lab.experiments.results import markdown
from lab.experiments.trials import run_trials
from presage.terminal.output import check_file, make_folder, provenance, write_json
from services.estimator.shared.model_folder import SHIPPED

# For the quantity of each column, its unit, and its names in the cards of presets `precise` and `paper`.
QUANTITIES = {
    "range error, median (mm)": (1e-3, ("test_range_error_median_m", "test_l1_median")),
    "range error, mean (mm)": (1e-3, ("test_range_error_mean_m", "test_l1_mean")),
    "more than 5 cm off (%)": (1e-2, ("test_share_above_5_cm",)),
    "position error, RMS (mm)": (1e-3, ("test_position_error_rms_m",)),
}


@dataclass(frozen=True)
class TrainingJob:
    """One training of one of the shipped models."""

    model: str  # name of its card, such as corridor-precise
    seed: int
    samples: int  # training scans
    out: str  # folder


def bench_training(
    models: str, seeds: int, samples: int | None, out: Path, json_file: Path | None, console: Console
) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given.

    ``models`` are comma-separated names of model cards, all of them if empty. Each is trained with its own number of
    ``samples`` if that is None. The trained models are written to ``out``. Raises UserError for an unknown model.
    """
    check_file(json_file, "--json")
    make_folder(out)
    names = models.split(",") if models else sorted(path.stem for path in SHIPPED.glob("*.json"))
    cards = {name: read_card(SHIPPED, name) for name in names}
    jobs = [
        TrainingJob(name, seed, samples or card["samples"], str(out))
        for name, card in cards.items()
        for seed in range(1, seeds + 1)
    ]
    # One after another: each training uses all cores.
    trained = run_trials("training", train, jobs, out, 1, console)
    rows = [
        {
            "model": name,
            "shipped": errors_of(card),
            "trained": [errors for job, errors in zip(jobs, trained, strict=True) if job.model == name],
        }
        for name, card in cards.items()
    ]
    print(table(rows))
    write_json(json_file, {"rows": rows, "seeds": seeds, **provenance()})


def read_card(folder: Path, name: str) -> dict[str, Any]:
    """The model card ``name`` in a folder. Raises UserError if there is none."""
    try:
        return dict(json.loads((folder / f"{name}.json").read_text(encoding="utf-8")))
    except FileNotFoundError:
        available = ", ".join(sorted(path.stem for path in folder.glob("*.json")))
        raise UserError(f"--models {name!r}: no such model; choose from {available}") from None


def train(job: TrainingJob) -> dict[str, Any]:
    """Trains a model as the shipped one was trained, with another seed. Returns its errors on test scans."""
    card, out = read_card(SHIPPED, job.model), Path(job.out) / f"seed{job.seed}"
    options = {
        "--world": card["world"]["name"],
        "--preset": card["preset"],
        "--beams": card["scanner"]["beams"],
        "--samples": job.samples,
        "--seed": job.seed,
        "--out": out,
    }
    command = [sys.executable, "-m", "presage", "train", *(f"{name}={value}" for name, value in options.items())]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own command
    if done.returncode != 0:
        raise UserError(f"{job.model}, seed {job.seed}: presage train failed: {done.stderr.strip()}")
    return {"seed": job.seed, **errors_of(read_card(out, job.model))}


def errors_of(card: dict[str, Any]) -> dict[str, float]:
    """The errors that a model card states."""
    names = [name for _, of_presets in QUANTITIES.values() for name in of_presets]
    return {name: card[name] for name in names if name in card}


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table of docs/results.md: errors of the shipped model, and the least and largest of the others."""

    def cell(row: dict[str, Any], unit: float, names: Iterable[str]) -> str:
        name = next((each for each in names if each in row["shipped"]), None)
        if name is None:
            return "–"
        others = [errors[name] for errors in row["trained"]]
        values = (row["shipped"][name], min(others), max(others))
        shipped, least, most = (f"{float(f'{value / unit:.3g}'):g}" for value in values)
        return f"{shipped}; {least} to {most}"

    cells = [[row["model"], *(cell(row, unit, names) for unit, names in QUANTITIES.values())] for row in rows]
    return markdown(("model", *QUANTITIES), cells)
