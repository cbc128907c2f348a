"""`presage experiment navigation`."""

from __future__ import annotations

from typing import Annotated

import typer

from lab.cli.options import CORES, OUT, Beams, ExperimentSeed, Out, Trials, Workers, show
from presage.terminal.options import console


def navigate(
    trials: Trials = 100,
    worlds: Annotated[str, typer.Option(help="Comma-separated names or files.")] = "maze,office",
    drives: Annotated[str, typer.Option(help="Comma-separated: holonomic, differential.")] = "holonomic,differential",
    start: Annotated[str, typer.Option(help="known, or unknown: the estimator is not told it.")] = "known",
    people: Annotated[int, typer.Option(min=0, max=100, help="How many walk about, unknown to the map.")] = 0,
    people_speed: Annotated[float, typer.Option(min=0.0, max=3.0, help="Of their walk, m/s.")] = 1.0,
    estimator: Annotated[str, typer.Option(help="precise or particle-filter.")] = "precise",
    epistemic: Annotated[
        bool, typer.Option(help="Drive so as to find out where it is, while it does not know.")
    ] = True,
    prior: Annotated[
        str, typer.Option(help="Of the estimator, of motion between scans: motion or odometry.")
    ] = "motion",
    beams: Beams = 622,
    limit: Annotated[float, typer.Option(min=1.0, max=3600.0, help="s of simulated time for each trial.")] = 120.0,
    seed: ExperimentSeed = 1,
    out: Out = OUT,
    workers: Workers = CORES + 1,
) -> None:
    """From anywhere to anywhere, round walls and people: reached, contacts, path and time over the least possible.

    Results are named after what is not as by default: navigation.json, navigation-unknown.json,
    navigation-office-people10.json. The same trial number is the same start and goal whatever the other options.

    Examples: `presage experiment navigation --trials 2`;
    `presage experiment navigation --worlds office --people 10`;
    `presage experiment navigation --worlds twins --start unknown --trials 50 --no-epistemic`;
    `presage experiment navigation --worlds my.yaml --drives differential --seed 7 --out mine`.
    """
    from lab.navigation import experiment as driving  # noqa: PLC0415

    job = driving.Job(
        0, seed, start=start, people=people, people_speed=people_speed, estimator=estimator, prior=prior,
        epistemic=epistemic, beams=beams, limit=limit,
    )  # fmt: skip
    where, how = (tuple(part.strip() for part in text.split(",") if part.strip()) for text in (worlds, drives))
    driving.check(job, where, how)
    show(driving, lambda: driving.run(job, trials, out, workers, console, worlds=where, drives=how), out)
