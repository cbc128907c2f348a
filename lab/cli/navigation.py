"""`presage experiment navigation`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from lab.cli.options import Trials, show, worker_count
from presage.terminal.options import console

if TYPE_CHECKING:
    from lab.experiments.results import Result


def navigate(
    context: typer.Context,
    trials: Trials = 100,
    worlds: Annotated[str, typer.Option(help="Comma-separated names or files.")] = "maze,office",
    drives: Annotated[str, typer.Option(help="Comma-separated: holonomic, differential.")] = "holonomic,differential",
    start: Annotated[
        str, typer.Option(help="known or unknown: whether the estimator is given the start pose.")
    ] = "known",
    people: Annotated[int, typer.Option(min=0, max=100, help="Number of walking people; the map lacks them.")] = 0,
    estimator: Annotated[str, typer.Option(help="precise or particle-filter.")] = "precise",
    epistemic: Annotated[
        bool, typer.Option(help="While the pose is ambiguous, drive to where scans resolve the ambiguity.")
    ] = True,
) -> None:
    """Navigation between random places, around walls and people.

    Measures goals reached, contacts, and path length and time relative to the minimum.

    Results are named after the options that differ from the defaults: navigation.json, navigation-unknown.json,
    navigation-office-people10.json. A trial number always has the same start and goal, whatever the other options.

    Examples: `presage experiment navigation --trials 2`;
    `presage experiment navigation --worlds office --people 10`;
    `presage experiment navigation --worlds twins --start unknown --trials 50 --no-epistemic`;
    `presage experiment --seed 7 --out mine navigation --worlds my.yaml --drives differential`.
    """
    from lab.navigation import experiment as driving

    seed, out = context.obj
    job = driving.NavigationJob(0, seed, start=start, people=people, estimator=estimator, epistemic=epistemic)
    world_names, drive_names = (
        tuple(part.strip() for part in text.split(",") if part.strip()) for text in (worlds, drives)
    )
    driving.check(job, world_names, drive_names)

    def run() -> Result:
        return driving.run(job, trials, out, worker_count(1), console, worlds=world_names, drives=drive_names)

    show(driving, run, out)
