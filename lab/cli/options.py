"""Options of the experiments."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from presage.terminal.options import console
from presage.terminal.output import make_folder

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

    from lab.experiments.results import Result

Trials = Annotated[int, typer.Option(min=1, help="How many; few are enough for a look.")]
ExperimentSeed = Annotated[int, typer.Option("--seed", min=0, max=2**31, help="Of places, noise, particles.")]
Out = Annotated[Path, typer.Option(help="Folder for NAME.json, .csv, .pdf, .png.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes side by side; none: one a core.")]
Estimators = Annotated[str, typer.Option(help="Comma-separated, as the table names them, without their own commas.")]
Alpha = Annotated[float | None, typer.Option(min=1e-8, max=1.0, help="Paper: step size, m²; none: the best found.")]
Steps = Annotated[int | None, typer.Option(min=1, help="Paper: gradient steps a scan; none: 1, as the paper.")]
World = Annotated[str, typer.Option(help="World that the paper's decoder and a field were trained for.")]
Beams = Annotated[int, typer.Option(min=2, help="Beams of the scanner.")]

OUT = Path("experiments")
CORES = os.cpu_count() or 1


def show(experiment: ModuleType, run: Callable[[], Result], out: Path) -> None:
    """Run it; its table, its notes, and where everything lies."""
    make_folder(out, "--out")
    result = run()
    print(f"\n{experiment.table(result.summary)}\n")
    if result.notes:
        console.print(*result.notes, sep="\n")
    console.print(f"{out / result.name}.json, .csv, .trials.jsonl, .pdf, .png")
