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

Trials = Annotated[int, typer.Option(min=1, help="Number of trials; a few are enough for a first impression.")]
ExperimentSeed = Annotated[
    int, typer.Option("--seed", min=0, max=2**31, help="Random seed of places, noise and particles.")
]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for NAME.json, .csv, .pdf, .png.")]
Estimators = Annotated[
    str,
    typer.Option(help="Comma-separated names as in the table, where 'precise, odometry' is one name. Defaults to all."),
]
Alpha = Annotated[
    float | None,
    typer.Option(
        min=1e-8, max=1.0, help="Step size of estimator paper in m². Defaults to the best value of the sweep."
    ),
]


def mount_pose(text: str) -> tuple[float, float, float] | None:
    """Pose of the laser in base_link (m, m, rad) in the option --mount; None if the text is empty."""
    from common.geometry.pose_text import parse_pose

    if not text:
        return None
    x, y, yaw = parse_pose(text, "--mount").tolist()
    return x, y, yaw


def worker_count(extra: int = 0) -> int:
    """Number of worker processes: PRESAGE_WORKERS. Defaults to one for each core, and ``extra`` ones."""
    return int(os.environ.get("PRESAGE_WORKERS") or (os.cpu_count() or 1) + extra)


def show(experiment: ModuleType, run: Callable[[], Result], out: Path) -> None:
    """Runs the experiment, then prints its table, its notes and the files it wrote."""
    make_folder(out)
    result = run()
    print(f"\n{experiment.table(result.summary)}\n")
    if result.notes:
        console.print(*result.notes, sep="\n")
    suffixes = (".json", ".csv", ".trials.jsonl", ".pdf", ".png")
    written = [suffix for suffix in suffixes if (out / f"{result.name}{suffix}").exists()]
    console.print(f"{out / result.name}{', '.join(written)}")
