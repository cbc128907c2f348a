"""The command line `presage`: reads arguments, calls what does the work, turns errors into one line."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from common.bus import DEFAULT_ENDPOINT
from common.errors import UserError, first_fault
from presage import (
    cli_bench,
    cli_experiment,
    cli_inspect,
    cli_obstacle,
    cli_recording,
    cli_replay,
    cli_secure,
    cli_tools,
)
from presage.options import (
    Connect,
    EstimatorName,
    Json,
    ModelName,
    OpenPage,
    People,
    PeopleSpeed,
    Port,
    PriorName,
    RobotName,
    Seed,
    StartPose,
    Viewer,
    WorldName,
    console,
    err_console,
    link_of,
)
from presage.output import make_folder
from presage.stack import ignoring_interrupts, interruptible

app = typer.Typer(
    help="A robot that localises itself and navigates by predicting what its laser will see.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


@app.command()
def up(
    world: WorldName = "corridor",
    beams: Annotated[int, typer.Option(help="Beams of the scanner; 622 are the paper's.")] = 811,
    drive: Annotated[str, typer.Option(help="holonomic or differential.")] = "holonomic",
    pace: Annotated[str, typer.Option(help="realtime, fast or lockstep.")] = "realtime",
    seed: Seed = 0,
    record: Annotated[Path | None, typer.Option(help="Record into this folder.")] = None,
    robot: RobotName = "robot",
    port: Port = 7447,
    estimator: EstimatorName = "precise",
    model: ModelName = "learned",
    prior: PriorName = "motion",
    viewer: Viewer = True,
    open_page: OpenPage = False,
    people: People = 0,
    people_speed: PeopleSpeed = 1.0,
    start: StartPose = "",
    robots: Annotated[
        int, typer.Option(min=1, max=20, help="Several: ROBOT-1, ROBOT-2 ..., each simulated by itself, one estimator.")
    ] = 1,
) -> None:
    """Start router, simulator, estimator, controller and the live page here, until Ctrl-C.

    The page's link is printed; PRESAGE_VIEWER_PORT and PRESAGE_VIEWER_TOKEN choose its port and who may see it.
    Examples: `presage up`, then elsewhere `presage goal 15 1.5 --wait`; `presage up --estimator particle-filter`;
    `presage up --record recordings --seed 7`; `presage up --world my.yaml --port 7500`; `presage up --no-viewer`;
    `presage up --world office --people 10 --start 9,3.5,90`; `presage up --robots 3`, then
    `presage goal 15 1.5 --robot robot-2`.
    """
    from presage.up import run_up  # noqa: PLC0415

    run_up(
        world=world,
        beams=beams,
        drive=drive,
        pace=pace,
        seed=seed,
        record=record,
        robot=robot,
        port=port,
        console=console,
        estimator=("--estimator", estimator, "--model", model, "--prior", prior),
        viewer=viewer,
        open_page=open_page,
        people=("--people", str(people), "--people-speed", str(people_speed)),
        start=start,
        robots=robots,
    )


@app.command()
def demo(
    world: WorldName = "corridor",
    goal: Annotated[tuple[float, float] | None, typer.Option(help="x y in m.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for recording and figure.")] = Path("recordings"),
    beams: Annotated[int, typer.Option(help="Beams of the scanner.")] = 622,
    seed: Seed = 0,
    pace: Annotated[str, typer.Option(help="realtime, fast or lockstep.")] = "realtime",
    port: Port = 0,
    json_file: Json = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Without the services' own lines, and the page.")] = False,
    estimator: EstimatorName = "precise",
    model: ModelName = "learned",
    viewer: Viewer = True,
    open_page: OpenPage = False,
    people: People = 0,
) -> None:
    """The whole loop, live on a page: localise from nothing, drive to a goal, record, draw, summarise.

    Examples: `presage demo`; `presage demo --goal 12 2 --seed 3 --json run.json`; `presage demo --pace lockstep`;
    `presage demo --people 3`.
    """
    from presage.demo import Demo, demo_command  # noqa: PLC0415

    how = ("--estimator", estimator, "--model", model)
    asked = Demo(world, goal, out, beams, seed, pace, port or None, how, viewer, open_page, people)
    raise typer.Exit(demo_command(asked, json_file, quiet=quiet))


@app.command()
def localize(
    file: Annotated[Path, typer.Argument(help=".npz (ranges, angles, range_max) or a recording (.mcap).")],
    world: Annotated[str, typer.Option(help="A shipped world or a world file; none: the recording's.")] = "",
    estimator: EstimatorName = "precise",
    model: ModelName = "learned",
    models: Annotated[Path | None, typer.Option(help="Folder of weights; none: the shipped ones.")] = None,
    out: Annotated[Path | None, typer.Option(help="NAME.csv or NAME.json; none: CSV to standard output.")] = None,
    frame: Annotated[
        str, typer.Option(help="base_link or laser: whose pose; of an .npz also its own poses'.")
    ] = "base_link",
    mount: Annotated[str, typer.Option(help="Of an .npz's laser in base_link: x,y,yaw_deg (m, m, deg).")] = "0.2,0,0",
    mode: Annotated[str, typer.Option(help="global: nothing is known; track: from initial_pose.")] = "global",
    fresh: Annotated[bool, typer.Option("--fresh", help="Each scan on its own.")] = False,
    odometry: Annotated[bool, typer.Option(help="Use the file's odometry, where there is any.")] = True,
    initial_pose: Annotated[str, typer.Option(help="x,y,yaw_deg; for mode track.")] = "",
    sigma: Annotated[float, typer.Option(min=1e-4, max=10, help="The scanner's noise, m.")] = 0.02,
    seed: Seed = 0,
) -> None:
    """Run an estimator over a file of scans, as fast as it goes; one row a scan.

    Columns: stamp (s), x, y (m), yaw (rad), covariance (cov_xx ... cov_yawyaw), free_energy (nats), state, update_ms.
    Examples: `presage localize scans.npz --world office --out poses.csv`;
    `presage localize run.mcap --estimator particle-filter --out poses.json`;
    `presage localize scans.npz --world office --fresh --frame laser`.
    """
    from presage.localize import Job, choice_of  # noqa: PLC0415
    from presage.localize import localize as run  # noqa: PLC0415

    choice = choice_of(file, world, estimator, model, models, sigma, seed, initial_pose)
    run(Job.of(file, choice, mode, frame, mount, fresh=fresh, odometry=odometry, out=out), err_console)


@app.command()
def train(
    world: WorldName = "corridor",
    preset: Annotated[str, typer.Option(help="precise or paper.")] = "precise",
    scanner: Annotated[str, typer.Option(help="A known scanner.")] = "tim571",
    out: Annotated[Path | None, typer.Option(help="Folder for weights and card; none: where services look.")] = None,
    beams: Annotated[int | None, typer.Option(min=2, help="Instead of the scanner's own number.")] = None,
    samples: Annotated[int | None, typer.Option(min=10, help="none: 5000, paper 13000.")] = None,
    resolution: Annotated[float, typer.Option(min=0.005, max=1.0, help="precise: m between nodes.")] = 0.04,
    epochs: Annotated[int, typer.Option(min=1, help="paper.")] = 60,
    batch: Annotated[int, typer.Option(min=1, help="paper.")] = 500,
    learning_rate: Annotated[float, typer.Option(min=1e-6, help="paper.")] = 3e-3,
    seed: Seed = 0,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Learn to predict a scanner in a world.

    Samples come from the scanner on the bus where it is in this world, else from a simulator of its own. An interrupted
    run of preset paper is taken up again by the same command.
    Examples: `presage train --world my.yaml`; `presage train --world corridor --preset paper --beams 622 --out mine`.
    """
    from presage import train as paper  # noqa: PLC0415
    from presage import train_precise as precise  # noqa: PLC0415
    from services.estimator.precise.learning import Recipe  # noqa: PLC0415
    from services.estimator.precise.weights import FOLDER  # noqa: PLC0415
    from services.estimator.training import Recipe as PaperRecipe  # noqa: PLC0415

    link, folder = link_of(connect, robot), out or FOLDER
    make_folder(folder, "--out")
    if preset == "precise":
        recipe = Recipe(resolution=resolution, seed=seed)
        precise.train_precise(precise.Job(world, scanner, beams, folder, samples or 5000, recipe), link, console)
    elif preset == "paper":
        descent = PaperRecipe(epochs=epochs, batch=batch, learning_rate=learning_rate, seed=seed)
        paper.train(paper.Job(world, preset, scanner, beams, folder, samples or 13_000, descent), link, console)
    else:
        raise UserError(f"no preset {preset!r}: choose precise or paper")


app.add_typer(cli_recording.app)
app.add_typer(cli_replay.app)
app.add_typer(cli_inspect.app)
app.add_typer(cli_tools.app)
app.add_typer(cli_bench.app, name="bench")
app.add_typer(cli_experiment.app, name="experiment")
app.add_typer(cli_secure.app, name="secure")
app.add_typer(cli_obstacle.app, name="obstacle")
cli_secure.with_security(app, cli_recording.app, cli_replay.app, cli_inspect.app, cli_tools.app, cli_obstacle.app)


def main() -> None:
    """Entry point: one line for what a user can mend, status 2; 130 after Ctrl-C."""
    os.environ.setdefault("PYTHONWARNINGS", "default")
    try:
        with interruptible():
            app()
    except (UserError, ValidationError, OSError) as error:
        print(f"presage: {_in_one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        with ignoring_interrupts():
            print("interrupted", file=sys.stderr)
        sys.exit(130)


def _in_one_line(error: UserError | ValidationError | OSError) -> str:
    """What is wrong, where, and what to do."""
    if isinstance(error, ValidationError):
        return f"{first_fault(error)} ({error.title}): see --help for what is meant"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}; choose another place"
    return " ".join(str(error).split()) or type(error).__name__
