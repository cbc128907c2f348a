"""Commands that rerun the paper's experiments, and those of its weaknesses."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from common.errors import UserError
from presage.options import console
from presage.output import make_folder

app = typer.Typer(
    help="The experiments of Burghardt & Lanillos 2021, for presets paper and precise and the particle filter.",
    no_args_is_help=True,
)

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


@app.command("e1")
def e1(
    trials: Trials = 100,
    iterations: Annotated[int, typer.Option(min=1, help="Scans of each trial.")] = 50,
    estimators: Estimators = "",
    alpha: Alpha = None,
    steps: Steps = None,
    world: World = "corridor",
    beams: Beams = 622,
    seed: ExperimentSeed = 1,
    out: Out = OUT,
    workers: Workers = CORES,
) -> None:
    """E1: where is a standing robot? Error against iterations.

    Examples: `presage experiment e1 --trials 5`; `presage experiment e1 --alpha 2e-4 --out slow`;
    `presage experiment e1 --estimators "paper,precise" --iterations 200`.
    """
    from presage.experiments import localisation  # noqa: PLC0415
    from presage.experiments.contestants import Field, chosen, descent_of  # noqa: PLC0415

    make_folder(out, "--out")
    job = localisation.Job(0, seed, iterations, field=Field(world, beams), descent=descent_of(alpha, steps))
    if estimators:
        job = replace(job, estimators=chosen(estimators))
    result = localisation.run(job, trials, out, workers, console)
    _say(result.name, localisation.table(result.summary), out)


@app.command("e2")
def e2(
    trials: Trials = 20,
    step: Annotated[float, typer.Option(min=1e-3, max=1.0, help="m, of each teleport.")] = 0.05,
    estimators: Estimators = "",
    alpha: Alpha = None,
    steps: Steps = None,
    world: World = "corridor",
    beams: Beams = 622,
    seed: ExperimentSeed = 1,
    out: Out = OUT,
    workers: Workers = CORES,
) -> None:
    """E2: crossing the map by small teleports at one heading. Error over time, with and without odometry.

    Examples: `presage experiment e2 --trials 2`; `presage experiment e2 --step 0.02 --out slower`.
    """
    from presage.experiments import crossing  # noqa: PLC0415
    from presage.experiments.contestants import Field, chosen, descent_of  # noqa: PLC0415

    make_folder(out, "--out")
    job = crossing.Job(0, seed, step, field=Field(world, beams), descent=descent_of(alpha, steps))
    if estimators:
        job = replace(job, estimators=chosen(estimators))
    result = crossing.run(job, trials, out, workers, console)
    _say(result.name, crossing.table(result.summary), out)


@app.command("alpha")
def alpha_sweep(
    trials: Trials = 50,
    alphas: Annotated[str, typer.Option(help="Comma-separated, m²; empty: 1e-4 to 2.4e-3.")] = "",
    seed: ExperimentSeed = 1,
    out: Out = OUT,
    workers: Workers = CORES,
) -> None:
    """The paper's step size α, swept on E1.

    Examples: `presage experiment alpha --trials 10`; `presage experiment alpha --alphas 2e-4,4e-4,8e-4`.
    """
    from presage.experiments import localisation, step_size  # noqa: PLC0415

    make_folder(out, "--out")
    try:
        wanted = tuple(float(part) for part in alphas.split(",")) if alphas else step_size.ALPHAS
    except ValueError:
        raise UserError(f"--alphas {alphas!r}: give numbers, such as 2e-4,4e-4") from None
    result = step_size.run(localisation.Job(0, seed, 50), trials, out, workers, console, wanted)
    _say(result.name, step_size.table(result.summary), out)
    console.print(*result.notes, sep="\n")


def _say(name: str, table: str, out: Path) -> None:
    """The table, and where everything lies."""
    print(f"\n{table}\n")
    console.print(f"{out / name}.json, .csv, .trials.jsonl, .pdf, .png")
