"""`presage experiment navigation`, `docking` and `exploration`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from common.limits import MAX_BEAMS
from common.names import split_names
from lab.cli.options import Trials, show, worker_count
from presage.terminal.options import console

if TYPE_CHECKING:
    from lab.experiments.results import Result


def navigate(
    context: typer.Context,
    trials: Trials = 100,
    worlds: Annotated[
        str,
        typer.Option(help="Comma-separated names or files; hall and look-alike are generated, one for five trials."),
    ] = "maze,office",
    drives: Annotated[str, typer.Option(help="Comma-separated: holonomic, differential.")] = "holonomic,differential",
    start: Annotated[
        str, typer.Option(help="known or unknown: whether the estimator is given the start pose.")
    ] = "known",
    people: Annotated[int, typer.Option(min=0, max=100, help="Number of walking people; the map lacks them.")] = 0,
    estimator: Annotated[str, typer.Option(help="precise or particle-filter.")] = "precise",
    prior: Annotated[str, typer.Option(help="motion or odometry: source of the motion between scans.")] = "motion",
    slip: Annotated[float, typer.Option(min=0, max=0.5, help="Mean share of its motion that a wheel loses.")] = 0.0,
    epistemic: Annotated[bool, typer.Option(help="Motions are also judged by the information that they gain.")] = True,
    sweep: Annotated[bool, typer.Option("--sweep", help="Scans are distorted by the robot's motion.")] = False,
    beams: Annotated[int, typer.Option(min=2, max=MAX_BEAMS, help="Number of beams.")] = 622,
    max_range: Annotated[float, typer.Option(min=0.1, max=100, help="Range of the scanner in m.")] = 25.0,
    limit: Annotated[float, typer.Option(min=1, help="Simulated time in s after which a trial ends.")] = 120.0,
) -> None:
    """Navigation between random places, around walls and people.

    Measures goals reached, contacts, and path length and time relative to the minimum.

    Results are named after the options that differ from the defaults: navigation.json, navigation-unknown.json,
    navigation-office-people10.json. A trial number always has the same start and goal, whatever the other options.

    Examples: `presage experiment navigation --trials 2`;
    `presage experiment navigation --worlds office --people 10`;
    `presage experiment navigation --worlds twins --start unknown --trials 50 --no-epistemic`;
    `presage experiment navigation --worlds hall --max-range 4 --prior odometry --slip 0.05`;
    `presage experiment --seed 7 --out mine navigation --worlds my.yaml --drives differential`.
    """
    from lab.navigation import experiment as driving

    seed, out = context.obj
    job = driving.NavigationJob(
        0,
        seed,
        start=start,
        people=people,
        estimator=estimator,
        prior=prior,
        slip=slip,
        epistemic=epistemic,
        sweep=sweep,
        beams=beams,
        range_max=max_range,
        limit=limit,
    )
    world_names, drive_names = tuple(split_names(worlds)), tuple(split_names(drives))
    driving.check(job, world_names, drive_names)

    def run() -> Result:
        return driving.run(job, trials, out, worker_count(1), console, worlds=world_names, drives=drive_names)

    show(driving, run, out)


def dock(context: typer.Context, trials: Trials = 100) -> None:
    """Docking within 3 mm and 0.5 degrees: a base with latency, dead band and slipping wheels, scans with distortion.

    Examples: `presage experiment docking --trials 4`; `presage experiment --seed 7 --out mine docking`.
    """
    from lab.navigation import docking

    seed, out = context.obj
    job = docking.DockingJob(0, seed)
    show(docking, lambda: docking.run(job, trials, out, worker_count(1), console), out)


def explore(
    context: typer.Context,
    starts: Annotated[int, typer.Option(min=1, help="Starts in each world.")] = 2,
    worlds: Annotated[str, typer.Option(help="Comma-separated names or files.")] = "maze,office",
    buildings: Annotated[int, typer.Option(min=0, help="Number of generated buildings, with one start each.")] = 5,
) -> None:
    """Exploration of unknown buildings, compared with a nearest-frontier explorer from the same starts.

    Examples: `presage experiment exploration --starts 1 --buildings 0`;
    `presage experiment --seed 7 --out mine exploration`.
    """
    from lab.exploration import experiment

    seed, out = context.obj
    names, job = split_names(worlds), experiment.ExplorationJob(seed)
    show(experiment, lambda: experiment.run(job, starts, names, buildings, out, worker_count(), console), out)
