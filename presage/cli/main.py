"""The command `presage`: up, demo, and the groups of commands."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from common.errors import UserError, first_fault
from common.packages import explain_missing_packages
from lab.cli import bench as cli_bench
from lab.cli import experiment as cli_experiment
from presage.cli import diagnosis as cli_diagnosis
from presage.cli import drive as cli_drive
from presage.cli import inspection as cli_inspect
from presage.cli import learning as cli_learning
from presage.cli import logs as cli_logs
from presage.cli import obstacle as cli_obstacle
from presage.cli import recording as cli_recording
from presage.cli import replay as cli_replay
from presage.cli import security as cli_secure
from presage.cli.session_options import Connect, RobotName
from presage.interrupts import ignoring_interrupts, interruptible
from presage.terminal.options import (
    Config,
    EstimatorName,
    GroupWithOptions,
    Json,
    ModelName,
    OpenPage,
    ScannerName,
    Seed,
    WorldName,
    arguments,
    console,
    model_setting,
)

app = typer.Typer(
    cls=GroupWithOptions,
    help="A robot that localises itself and navigates by predicting what its laser will see.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def _print_version(requested: bool) -> None:
    if requested:
        from common.versions import versions

        console.print(", ".join(f"{name} {version}" for name, version in versions().items()), soft_wrap=True)
        raise typer.Exit


@app.callback()
def options(
    connect: Connect = "",
    robot: RobotName = "",
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print versions and exit.")
    ] = False,
) -> None:
    """A robot that localises itself and navigates by predicting what its laser will see."""


@app.command(rich_help_panel="Run", short_help="All services and the live page on this machine, until Ctrl-C.")
def up(
    world: WorldName = "",
    robots: Annotated[
        int,
        typer.Option(min=1, max=20, help="Number of robots, each in its own simulation. One estimator serves all."),
    ] = 1,
    estimator: EstimatorName = "",
    model: ModelName = "",
    scanner: ScannerName = "",
    drive: Annotated[str, typer.Option(help="Drive of the robot: holonomic or differential.")] = "",
    people: Annotated[
        int | None, typer.Option(min=0, max=100, help="Number of walking people, who are not in the map.")
    ] = None,
    seed: Seed = None,
    record: Annotated[Path | None, typer.Option(help="Record into this folder.")] = None,
    mapping: Annotated[
        bool,
        typer.Option(
            "--mapping",
            help="Map an unknown building while `presage explore` or a person drives the robot (docs/mapping.md).",
        ),
    ] = False,
    learn: Annotated[
        bool, typer.Option("--learn", help="Improve the model while driving, and follow changes (docs/refinement.md).")
    ] = False,
    port: Annotated[
        int,
        typer.Option(min=0, max=65535, help="TCP port of the router on 127.0.0.1. 0 chooses a free port."),
    ] = 7447,
    config: Config = None,
    no_simulator: Annotated[
        bool, typer.Option("--no-simulator", help="Take the scans of a real robot or a bridge instead.")
    ] = False,
    no_estimator: Annotated[bool, typer.Option("--no-estimator", help="Use your own estimator instead.")] = False,
    no_controller: Annotated[bool, typer.Option("--no-controller", help="Use your own controller instead.")] = False,
    no_viewer: Annotated[bool, typer.Option("--no-viewer", help="Do not serve the live page.")] = False,
    open_page: OpenPage = False,
) -> None:
    """Start router, simulator, estimator, controller and live page on this machine, and run them until Ctrl-C.

    Other commands find the session by themselves. All other settings, such as the robot's size and speed, stand in a
    settings file or in environment variables: `max_speed: 0.5` is PRESAGE_MAX_SPEED=0.5.

    Examples: `presage up`, then in another terminal `presage goal 15 1.5 --wait`;
    `presage up --world office --people 10 --record recordings --seed 7`; `presage up --estimator particle-filter`;
    `presage up --world office --mapping`; `presage up --world rough.yaml --model exact --learn`;
    `presage up --robots 3`, then `presage --robot robot-2 goal 15 1.5`; `presage up --config turtlebot.yaml`.
    """
    from presage.session.up import UpOptions, run_up

    left_out = {
        "simulator": no_simulator,
        "estimator": no_estimator,
        "controller": no_controller,
        "viewer": no_viewer,
    }
    chosen = UpOptions(
        config,
        world,
        drive,
        simulator=arguments(scanner=scanner, people=people, seed=seed),
        estimator=arguments(estimator=estimator, learn="refine" if learn else None, **model_setting(model)),
        robots=robots,
        record=record,
        port=port,
        mapping=mapping,
        without=frozenset(name for name, left in left_out.items() if left),
        open_page=open_page,
    )
    run_up(chosen, console)


@app.command(rich_help_panel="Run", short_help="The whole loop once: localise, drive, record, draw, summarise.")
def demo(
    unknown: Annotated[
        bool,
        typer.Option("--unknown", help="In an unknown building: explore, be kidnapped, drive to a goal, return."),
    ] = False,
    world: WorldName = "",
    goal: Annotated[
        tuple[float, float] | None, typer.Option(help="Goal as X Y in m. Defaults to a free place far from the start.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the recording and the figure.")] = Path(
        "recordings"
    ),
    seed: Seed = None,
    estimator: EstimatorName = "",
    config: Config = None,
    json_file: Json = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Do not print the services' log lines, and do not serve the live page.")
    ] = False,
    open_page: OpenPage = False,
) -> None:
    """Run the whole loop once: localise without a start pose, drive to a goal, record, draw and summarise.

    With --unknown, the robot maps a building that it has never seen, by default `office`: it explores, is kidnapped,
    localises itself in its map, drives to a goal given meanwhile, explores the rest and returns. This takes two and a
    half minutes.

    The live page shows it while it runs. Exits with status 1 if the goal is not reached, or a step fails.

    Examples: `presage demo`; `presage demo --goal 12 2 --seed 3 --json run.json`; `presage demo --world office`;
    `presage demo --unknown --open`.
    """
    from presage.session.demo import DemoOptions, demo_command
    from presage.session.unknown_demo import unknown_demo_command

    chosen = DemoOptions(config, world, goal, out, seed or 0, estimator, quiet, open_page)
    raise typer.Exit((unknown_demo_command if unknown else demo_command)(chosen, json_file))


# The groups of the help appear in this order.
app.add_typer(cli_drive.app)
app.add_typer(
    cli_obstacle.app, name="obstacle", rich_help_panel="Drive", short_help="List, add, move and remove obstacles."
)
app.add_typer(cli_recording.app)
app.add_typer(cli_replay.app)
app.add_typer(cli_inspect.app)
app.add_typer(cli_logs.app)
app.add_typer(cli_learning.app)
app.add_typer(cli_diagnosis.app)
app.add_typer(
    cli_secure.app,
    name="secure",
    rich_help_panel="Diagnose",
    short_help="Certificates and access rights of secure mode.",
)
app.add_typer(
    cli_bench.app, name="bench", rich_help_panel="Lab", short_help="Benchmarks against a baseline or a limit."
)
app.add_typer(
    cli_experiment.app,
    name="experiment",
    rich_help_panel="Lab",
    short_help="The paper's experiments, navigation, and real logs.",
)


def main() -> None:
    """Runs the command line; errors that a user can correct become one line and status 2, Ctrl-C status 130."""
    os.environ.setdefault("PYTHONWARNINGS", "default")
    try:
        with interruptible(), explain_missing_packages():
            app()
    except (UserError, ValidationError, OSError) as error:
        print(f"presage: {_in_one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        with ignoring_interrupts():
            print("interrupted", file=sys.stderr)
        sys.exit(130)


def _in_one_line(error: UserError | ValidationError | OSError) -> str:
    """The error as a message that says what is wrong, where, and what to do."""
    if isinstance(error, ValidationError):
        return f"{first_fault(error)} ({error.title}): see --help for the allowed values"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}; choose another place"
    return " ".join(str(error).split()) or type(error).__name__
