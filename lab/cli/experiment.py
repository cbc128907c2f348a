"""`presage experiment`."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from common.errors import UserError
from lab.cli.navigation import dock, explore, navigate
from lab.cli.options import Alpha, Estimators, ExperimentSeed, Out, Trials, mount_pose, show, worker_count
from presage.terminal.options import GroupWithOptions, console
from presage.terminal.output import make_folder

app = typer.Typer(no_args_is_help=True, cls=GroupWithOptions)


@app.callback()
def common_options(context: typer.Context, seed: ExperimentSeed = 1, out: Out = Path("experiments")) -> None:
    """The experiments of Burghardt & Lanillos 2021 with presets paper and precise and the particle filter.

    Also navigation around walls and people, docking, exploration, and localisation on real logs.
    """
    context.obj = seed, out


@app.command("e1")
def e1(
    context: typer.Context,
    trials: Trials = 100,
    iterations: Annotated[int, typer.Option(min=1, help="Scans per trial.")] = 50,
    estimators: Estimators = "",
    alpha: Alpha = None,
) -> None:
    """E1: global localisation of a standing robot; error over iterations.

    Examples: `presage experiment e1 --trials 5`; `presage experiment --out slow e1 --alpha 5e-4`;
    `presage experiment e1 --estimators "paper,precise" --iterations 200`.
    """
    from lab.experiments.estimators import PAPER_DESCENT, parse_estimators
    from lab.paper import e1_localisation

    seed, out = context.obj
    job = e1_localisation.LocalisationJob(0, seed, iterations)
    job = replace(job, descent=replace(PAPER_DESCENT, alpha=alpha)) if alpha is not None else job
    job = replace(job, estimators=parse_estimators(estimators)) if estimators else job
    show(e1_localisation, lambda: e1_localisation.run(job, trials, out, worker_count(), console), out)


@app.command("e2")
def e2(
    context: typer.Context,
    trials: Trials = 12,
    estimators: Estimators = "",
) -> None:
    """E2: crossing the map by small teleports at constant heading; error over time, with and without odometry.

    Examples: `presage experiment e2 --trials 2`; `presage experiment e2 --estimators precise`.
    """
    from lab.experiments.estimators import parse_estimators
    from lab.paper import e2_crossing

    seed, out = context.obj
    job = e2_crossing.CrossingJob(0, seed)
    job = replace(job, estimators=parse_estimators(estimators)) if estimators else job
    show(e2_crossing, lambda: e2_crossing.run(job, trials, out, worker_count(), console), out)


@app.command("e3")
def e3(
    context: typer.Context,
    trials: Trials = 50,
    free: Annotated[
        bool, typer.Option("--free/--any", help="Require a free straight line from start to goal, or allow any pair.")
    ] = True,
    estimators: Estimators = "",
) -> None:
    """E3: navigation from a known start to a goal, through the real processes in lockstep over zenoh.

    Examples: `presage experiment e3 --trials 2`; `presage experiment --out near e3 --estimators precise`;
    `presage experiment --out any e3 --any --trials 20 --estimators precise`.
    """
    from lab.experiments.estimators import parse_estimators
    from lab.paper import e3_navigation

    seed, out = context.obj
    job = e3_navigation.PaperNavigationJob(0, seed, free=free)
    job = replace(job, estimators=parse_estimators(estimators)) if estimators else job
    show(e3_navigation, lambda: e3_navigation.run(job, trials, out, worker_count(), console), out)


@app.command("alpha")
def step_size_of_perception(
    context: typer.Context,
    trials: Trials = 25,
) -> None:
    """E1 with a range of values for the paper's step size α.

    Example: `presage experiment alpha --trials 10`.
    """
    from lab.paper import alpha_sweep, e1_localisation

    seed, out = context.obj
    job = e1_localisation.LocalisationJob(0, seed, 50)
    show(alpha_sweep, lambda: alpha_sweep.run(job, trials, out, worker_count(), console), out)


@app.command("steps")
def step_sizes_of_action(context: typer.Context, trials: Trials = 10) -> None:
    """E3 with a range of step sizes β and γ, also with the paper's teleports: which give the paper's 12.5 iterations.

    Example: `presage experiment steps --trials 2`.
    """
    from lab.paper import step_sizes

    seed, out = context.obj
    job = step_sizes.StepSizeJob(0, seed)
    show(step_sizes, lambda: step_sizes.run(job, trials, out, worker_count(), console), out)


@app.command("samples")
def samples_needed(
    context: typer.Context,
) -> None:
    """Prediction error and localisation error as functions of the number of training samples.

    Example: `presage experiment samples`.
    """
    from lab.paper import samples

    seed, out = context.obj
    show(samples, lambda: samples.run(samples.SamplesJob(seed), out, worker_count(), console), out)


@app.command("aliasing")
def similar_objects(
    context: typer.Context,
    trials: Trials = 30,
) -> None:
    """Worlds with similar objects or two identical rooms: places found, places reported wrongly, both rooms kept.

    First trains the estimators in three worlds, which takes several minutes however few the trials are.

    Example: `presage experiment aliasing --trials 5`.
    """
    from lab.paper import aliasing

    seed, out = context.obj
    show(aliasing, lambda: aliasing.run(aliasing.AliasingJob(seed, places=trials), out, worker_count(), console), out)


@app.command("prediction")
def predicted(
    context: typer.Context,
) -> None:
    """Predicted and measured scans compared, with the models' stated precision (the paper's figure 2c).

    Example: `presage experiment --seed 7 --out other prediction`.
    """
    from lab.paper import prediction

    seed, out = context.obj
    show(prediction, lambda: prediction.run(prediction.PredictionJob(seed), out, 1, console), out)


@app.command("real")
def real_drive(
    context: typer.Context,
    log: Annotated[Path, typer.Option(help="Recording or log with reference poses (docs/logs.md).")],
    world: Annotated[str, typer.Option(help="World file or ROS map.yaml of the training half.")],
    name: Annotated[str, typer.Option(help="Results are named real-NAME. Defaults to the log's name.")] = "",
    mount: Annotated[
        str, typer.Option(help="Pose of the laser in base_link, x,y[,yaw_deg] (m, deg). Defaults to the log's.")
    ] = "",
    every: Annotated[int, typer.Option(min=1, help="Number of scans between the starts of tasks c and d.")] = 50,
    quick: Annotated[
        bool, typer.Option("--quick", help="First impression: few scans, and the particle filter is not tuned.")
    ] = False,
    exchange: Annotated[
        bool, typer.Option("--exchange", help="Train on the second half and localise on the first.")
    ] = False,
) -> None:
    """A real log: trains and tunes on its first half, and localises on its second half.

    Compares preset precise with the particle filter in four tasks. a: tracking with odometry; b: tracking without;
    c: global localisation, starting at every 50th scan; d: kidnapping. Errors are relative to the log's reference
    poses. After Ctrl-C the same command continues, unless the code has changed.
    Examples: `presage map drive.npz --mount 0,0,0 --poses reference --half first --no-learn -o first_half.yaml`, then
    `presage experiment real --log drive.npz --mount 0,0,0 --world first_half.yaml --quick`;
    `presage experiment --out mine real --log fr079.mcap --world fr079.yaml --name fr079 --every 50`.
    """
    from lab.real_logs import experiment

    seed, out = context.obj
    if not re.fullmatch(r"[\w.-]*", name):
        raise UserError(f"--name {name!r}: use only letters, digits, '.', '_' and '-', as it becomes a file name")
    job = experiment.RealLogJob(log, world, mount_pose(mount), every, quick, seed, name, exchange)
    show(experiment, lambda: experiment.run(job, out, worker_count(), console), out)


@app.command("peers")
def peers(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(help="Folder with world.yaml, a ROS map*.yaml, held.npz and track.npz.")],
    trials: Annotated[int, typer.Option(min=1, help="Maximum number of trials of each task.")] = 100,
    estimators: Estimators = "",
) -> None:
    """The scans on which Nav2's AMCL, Beluga and MRPT were measured (docs/peers.md), with the same protocol.

    Processor times are of one thread if OMP_NUM_THREADS=1. After Ctrl-C the same command continues, unless the code has
    changed.
    Examples: `presage experiment peers scans --trials 3`;
    `presage experiment --out mine peers scans --estimators "presage polygons,presage 5 cm map"`.
    """
    from lab.experiments.estimators import parse_estimators
    from lab.peers import experiment

    seed, out = context.obj
    names = parse_estimators(estimators, experiment.ESTIMATORS) if estimators else tuple(experiment.ESTIMATORS)
    show(experiment, lambda: experiment.run(folder, names, trials, seed, out, worker_count(), console), out)


@app.command("all")
def all_experiments(
    context: typer.Context,
    trials: Annotated[
        int,
        typer.Option(min=0, help="Maximum number of trials of each experiment; 0 for each one's own number."),
    ] = 0,
) -> None:
    """Every experiment of the paper, one after another.

    After Ctrl-C the same command continues, unless the code has changed.
    Examples: `presage experiment all`; `presage experiment --out look all --trials 3`.
    """
    from lab.paper.suite import run_all

    seed, out = context.obj
    make_folder(out)
    run_all(trials, seed, out, worker_count(), console)


@app.command("tables")
def tables(
    context: typer.Context,
    page: Annotated[Path | None, typer.Option(help="Markdown file in which to replace the marked tables.")] = None,
) -> None:
    """Tables of existing results, as Markdown or inserted into a page.

    Examples: `presage experiment tables`;
    `presage experiment --out docs/experiments tables --page docs/experiments.md`.
    """
    from lab.pages.tables_page import MODULES, fill_tables, table_of

    _, out = context.obj
    if page is not None:
        page.write_text(fill_tables(page.read_text(encoding="utf-8"), out), encoding="utf-8")
        return
    names = [name for name in MODULES if (out / f"{name}.json").exists()]
    names += sorted(path.stem for kind in ("navigation", "real") for path in out.glob(f"{kind}-*.json"))
    if not names:
        raise UserError(
            f"no results in {out}: create them with `presage experiment all`, or give `presage experiment --out`"
        )
    for name in names:
        print(f"\n{name}\n\n{table_of(name, out)}")


app.command("navigation")(navigate)
app.command("docking")(dock)
app.command("exploration")(explore)
