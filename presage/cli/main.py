"""The command `presage`: up, demo, train, and the groups of commands."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from pydantic import ValidationError

from common.bus.bus import DEFAULT_ENDPOINT
from common.errors import UserError, first_fault
from common.robot.scanner_options import chosen_scanner, scanner_arguments
from lab.cli import bench as cli_bench
from lab.cli import experiment as cli_experiment
from presage.cli import inspection as cli_inspect
from presage.cli import logs as cli_logs
from presage.cli import obstacle as cli_obstacle
from presage.cli import recording as cli_recording
from presage.cli import replay as cli_replay
from presage.cli import security as cli_secure
from presage.cli import session as cli_tools
from presage.session.stack import ignoring_interrupts, interruptible
from presage.terminal.options import (
    Acceleration,
    Beams,
    Connect,
    DriveName,
    EstimatorName,
    Json,
    MaxSpeed,
    MaxTurn,
    ModelName,
    MountText,
    OpenPage,
    People,
    PeopleSpeed,
    Port,
    PriorName,
    Radius,
    RobotName,
    ScannerName,
    Seed,
    StartPose,
    TurnAcceleration,
    UpsideDown,
    Viewer,
    WorldName,
    console,
    link_of,
    robot_arguments,
)
from presage.terminal.output import make_folder

if TYPE_CHECKING:
    from services.estimator.precise.learning.field_learning import Recipe

PACE_HELP = (
    "Pace of the simulation: realtime, fast (as fast as possible), or lockstep (each scan waits for the command"
    " that answers it)."
)

app = typer.Typer(
    help="A robot that localises itself and navigates by predicting what its laser will see.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def _print_version(requested: bool) -> None:
    if requested:
        from common.versions import versions  # noqa: PLC0415

        console.print(", ".join(f"{name} {version}" for name, version in versions().items()), soft_wrap=True)
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print versions and exit.")
    ] = False,
) -> None:
    """A robot that localises itself and navigates by predicting what its laser will see."""


@app.command(rich_help_panel="Run", short_help="All services and the live page on this machine, until Ctrl-C.")
def up(
    world: WorldName = "corridor",
    beams: Beams = None,
    drive: DriveName = "holonomic",
    pace: Annotated[str, typer.Option(help=PACE_HELP)] = "realtime",
    seed: Seed = 0,
    record: Annotated[Path | None, typer.Option(help="Record into this folder.")] = None,
    robot: RobotName = "robot",
    simulator: Annotated[
        bool, typer.Option(help="Start the simulator. Without it, a real robot or a bridge must publish the scans.")
    ] = True,
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
        int,
        typer.Option(
            min=1,
            max=20,
            help="Number of robots, named ROBOT-1, ROBOT-2 and so on. Each has its own simulation; they share one"
            " estimator.",
        ),
    ] = 1,
    scanner: ScannerName = "tim571",
    mount: MountText = "",
    upside_down: UpsideDown = False,
    radius: Radius = None,
    max_speed: MaxSpeed = None,
    max_turn: MaxTurn = None,
    acceleration: Acceleration = None,
    turn_acceleration: TurnAcceleration = None,
) -> None:
    """Start router, simulator, estimator, controller and live page on this machine, and run them until Ctrl-C.

    The address of the page is printed. PRESAGE_VIEWER_PORT sets its port and PRESAGE_VIEWER_TOKEN its access token.

    Examples: `presage up`, then in another terminal `presage goal 15 1.5 --wait`;
    `presage up --estimator particle-filter`;
    `presage up --record recordings --seed 7`; `presage up --world my.yaml --port 7500`; `presage up --no-viewer`;
    `presage up --world office --people 10 --start 9,3.5,90`; `presage up --robots 3`, then
    `presage goal 15 1.5 --robot robot-2`; `presage up --scanner my-laser.yaml`;
    `presage up --scanner rplidar-a1 --mount=-0.1,0,180 --upside-down`;
    `presage up --drive differential --radius 0.105 --max-speed 0.22 --mount=-0.032,0` (a TurtleBot 3).
    """
    from presage.session.up import run_up  # noqa: PLC0415

    run_up(
        world=world,
        scanner=scanner_arguments(scanner, beams, mount, upside_down=upside_down),
        limits=robot_arguments(drive, radius, max_speed, max_turn, acceleration, turn_acceleration),
        pace=pace,
        seed=seed,
        record=record,
        robot=robot,
        simulated=simulator,
        port=port,
        console=console,
        estimator=("--estimator", estimator, "--model", model, "--prior", prior),
        viewer=viewer,
        open_page=open_page,
        people=("--people", str(people), "--people-speed", str(people_speed)),
        start=start,
        robots=robots,
    )


@app.command(rich_help_panel="Run", short_help="The whole loop once: localise, drive, record, draw, summarise.")
def demo(
    world: WorldName = "corridor",
    goal: Annotated[
        tuple[float, float] | None, typer.Option(help="Goal as X Y in m. Defaults to a free place far from the start.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the recording and the figure.")] = Path("recordings"),
    beams: Annotated[int, typer.Option(help="Beams per scan.")] = 622,
    seed: Seed = 0,
    pace: Annotated[str, typer.Option(help=PACE_HELP)] = "realtime",
    port: Port = 0,
    json_file: Json = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Do not print the services' log lines, and do not serve the live page.")
    ] = False,
    estimator: EstimatorName = "precise",
    model: ModelName = "learned",
    viewer: Viewer = True,
    open_page: OpenPage = False,
    people: People = 0,
) -> None:
    """Run the whole loop once: localise without a start pose, drive to a goal, record, draw and summarise.

    The live page shows it while it runs. Exits with status 1 if the goal is not reached.

    Examples: `presage demo`; `presage demo --goal 12 2 --seed 3 --json run.json`; `presage demo --pace lockstep`;
    `presage demo --people 3`.
    """
    from presage.session.demo import DemoOptions, demo_command  # noqa: PLC0415

    estimator_arguments = ("--estimator", estimator, "--model", model)
    options = DemoOptions(
        world, goal, out, beams, seed, pace, port or None, estimator_arguments, viewer, open_page, people
    )
    raise typer.Exit(demo_command(options, json_file, quiet=quiet))


@app.command(rich_help_panel="Learn", short_help="Train the model of a world, or of a recorded drive.")
def train(
    world: Annotated[
        str,
        typer.Option(
            help="World name or world file. Defaults to corridor; with --from, to no world (only the drive is used)."
        ),
    ] = "",
    preset: Annotated[str, typer.Option(help="Estimator preset to train: precise or paper.")] = "precise",
    scanner: ScannerName = "tim571",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the weights and the model card. Defaults to the folder the services read."),
    ] = None,
    beams: Beams = None,
    samples: Annotated[
        int | None,
        typer.Option(
            min=10, help="Number of simulated scans. Defaults to 5000 (precise), 13000 (paper) or 2000 (with --from)."
        ),
    ] = None,
    resolution: Annotated[
        float | None,
        typer.Option(
            min=0.005,
            max=1.0,
            help="Grid spacing of the distance field (precise only), m. Defaults to 0.04, with --from to 0.05.",
        ),
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, help="Training epochs (paper only).")] = 60,
    batch: Annotated[int, typer.Option(min=1, help="Batch size (paper only).")] = 500,
    learning_rate: Annotated[float, typer.Option(min=1e-6, help="Learning rate (paper only).")] = 3e-3,
    seed: Seed = 0,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
    mount: MountText = "",
    upside_down: UpsideDown = False,
    drive: Annotated[
        Path | None,
        typer.Option(
            "--from", help="Log or recording with reference poses whose scans train and calibrate (precise only)."
        ),
    ] = None,
    share: Annotated[
        float,
        typer.Option(
            min=0.01,
            max=1.0,
            help="Share of the drive of --from to train on, from its beginning; 0.5 leaves half for tests.",
        ),
    ] = 1.0,
) -> None:
    """Train the generative model of a world, or of a recorded drive.

    The training scans come from the scanner on the bus if it is in this world, otherwise from a simulator that the
    command starts. To resume an interrupted run of preset paper, give the same command again.

    Examples: `presage train --world my.yaml`; `presage train --world corridor --preset paper --beams 622 --out mine`;
    `presage train --world my.yaml --scanner my-laser.yaml --mount 0.1,0,0`.

    With --from no simulator is needed: the model learns from the scans of the drive at their reference poses. Every
    fifth scan is held out to measure the prediction error, which the model card beside the weights reports. With
    --world as well, scans simulated in that map cover the places that the drive did not visit.

    Examples: `presage train --from drive.npz --out mine`;
    `presage train --from drive.npz --mount 0,0,0 --world map.yaml --share 0.5 --out mine` (poses of the laser itself);
    then `presage localize drive.npz --mount 0,0,0 --world map.yaml --models mine`.
    """
    from presage.learning import train_precise as precise  # noqa: PLC0415
    from presage.learning import train_simulated as paper  # noqa: PLC0415
    from services.estimator.paper.training import Recipe as PaperRecipe  # noqa: PLC0415
    from services.estimator.precise.learning.field_learning import Recipe  # noqa: PLC0415
    from services.estimator.precise.learning.weights import FOLDER  # noqa: PLC0415

    if drive is not None:
        recipe = Recipe(resolution or 0.05, seed=seed)
        _train_from_drive(drive, world, preset, out or FOLDER, samples or 2000, recipe, share, mount, upside_down)
        return
    world, resolution = world or "corridor", resolution or 0.04
    link, folder = link_of(connect, robot), out or FOLDER
    simulator_arguments = scanner_arguments(scanner, beams, mount, upside_down=upside_down)
    chosen = chosen_scanner(scanner, beams, mount=mount, upside_down=upside_down or None)
    make_folder(folder, "--out")
    if preset == "precise":
        recipe = Recipe(resolution=resolution, seed=seed)
        precise.train_precise(
            precise.TrainPreciseOptions(world, chosen, simulator_arguments, folder, samples or 5000, recipe),
            link,
            console,
        )
    elif preset == "paper":
        descent = PaperRecipe(epochs=epochs, batch=batch, learning_rate=learning_rate, seed=seed)
        paper.train(
            paper.TrainPaperOptions(world, preset, chosen, simulator_arguments, folder, samples or 13_000, descent),
            link,
            console,
        )
    else:
        raise UserError(f"no preset {preset!r}: choose precise or paper")


def _train_from_drive(
    drive: Path, world: str, preset: str, out: Path, samples: int, recipe: Recipe, share: float, mount: str,
    upside_down: bool,
) -> None:  # fmt: skip
    from presage.learning.train_drive import TrainDriveOptions, train_from_drive  # noqa: PLC0415
    from presage.logs.options import reading_of  # noqa: PLC0415

    if preset != "precise":
        raise UserError(
            f"--from trains preset precise, not {preset}: the paper's decoder needs scans taken at one heading"
        )
    make_folder(out, "--out")
    # Without the option, None: the orientation is taken from the log.
    reading = reading_of(
        mount, "", "", "", "", "", "sensor", reference=None, range_max=None, upside_down=upside_down or None
    )
    train_from_drive(TrainDriveOptions(drive, world, out, samples, recipe, share, reading), console)


app.add_typer(cli_tools.app)
app.add_typer(cli_recording.app)
app.add_typer(cli_replay.app)
app.add_typer(cli_inspect.app)
app.add_typer(cli_logs.app)
app.add_typer(
    cli_bench.app, name="bench", rich_help_panel="Lab", short_help="Benchmarks against a baseline or a limit."
)
app.add_typer(
    cli_experiment.app, name="experiment", rich_help_panel="Lab",
    short_help="The paper's experiments, navigation, and real logs.",
)  # fmt: skip
app.add_typer(
    cli_secure.app,
    name="secure",
    rich_help_panel="Diagnose",
    short_help="Certificates and access rights of secure mode.",
)
app.add_typer(
    cli_obstacle.app, name="obstacle", rich_help_panel="Drive", short_help="Add, move and remove simulated obstacles."
)
cli_secure.with_security(app, cli_recording.app, cli_replay.app, cli_inspect.app, cli_tools.app, cli_obstacle.app)


def main() -> None:
    """Runs the command line; errors that a user can correct become one line and status 2, Ctrl-C status 130."""
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
    """The error as a message that says what is wrong, where, and what to do."""
    if isinstance(error, ValidationError):
        return f"{first_fault(error)} ({error.title}): see --help for the allowed values"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}; choose another place"
    return " ".join(str(error).split()) or type(error).__name__
