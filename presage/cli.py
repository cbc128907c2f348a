"""The command line `presage`: reads arguments, calls what does the work, turns errors into one line."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from common.bus import DEFAULT_ENDPOINT, Link
from common.config import split_endpoints
from common.errors import UserError
from presage.stack import ignoring_interrupts, interruptible

app = typer.Typer(
    help="A robot that localises itself and navigates by predicting what its laser will see.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
bench_app = typer.Typer(
    help="Measure: speed and latency, as ratios against a peer in the same run.", no_args_is_help=True
)
app.add_typer(bench_app, name="bench")
console = Console(width=None if sys.stdout.isatty() else 150)

Robot_ = Annotated[str, typer.Option(envvar="PRESAGE_ROBOT", help="Which robot.")]
Connect = Annotated[str, typer.Option(envvar="PRESAGE_CONNECT", help="The session's zenoh endpoint(s).")]
World_ = Annotated[str, typer.Option(envvar="PRESAGE_WORLD", help="A shipped world or a world file.")]
Port = Annotated[int, typer.Option(min=0, max=65535, help="The router's port on 127.0.0.1; 0: any free one.")]
Json = Annotated[Path | None, typer.Option("--json", help="Write the numbers there.")]


def _link(connect: str, robot: str) -> Link:
    return replace(Link(), robot=robot, connect=split_endpoints(connect))


@app.command()
def up(
    world: World_ = "corridor",
    beams: Annotated[int, typer.Option(help="Beams of the scanner; 622 are the paper's.")] = 811,
    drive: Annotated[
        str, typer.Option(help="holonomic or differential (hand driving only, with preset paper).")
    ] = "holonomic",
    pace: Annotated[str, typer.Option(help="realtime, fast or lockstep.")] = "realtime",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    record: Annotated[Path | None, typer.Option(help="Record into this folder.")] = None,
    robot: Robot_ = "robot",
    port: Port = 7447,
) -> None:
    """Start router, simulator, estimator and controller here, until Ctrl-C.

    Examples: `presage up`, then elsewhere `presage goal 15 1.5 --wait`;
    `presage up --record recordings --seed 7`; `presage up --world my.yaml --port 7500`.
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
    )


@app.command()
def demo(
    world: World_ = "corridor",
    goal: Annotated[tuple[float, float] | None, typer.Option(help="x y in m.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for recording and figure.")] = Path("recordings"),
    beams: Annotated[int, typer.Option(help="Beams of the scanner.")] = 622,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    pace: Annotated[str, typer.Option(help="realtime, fast or lockstep.")] = "realtime",
    port: Port = 0,
    json_file: Json = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Without the services' own lines.")] = False,
) -> None:
    """The whole loop: localise from the map's centre, drive to a goal, record, draw, summarise.

    Examples: `presage demo`; `presage demo --goal 12 2 --seed 3 --json run.json`; `presage demo --pace lockstep`.
    """
    from presage.demo import Demo, demo_command  # noqa: PLC0415

    raise typer.Exit(demo_command(Demo(world, goal, out, beams, seed, pace, port or None), json_file, quiet=quiet))


@app.command()
def goal(
    x: Annotated[float | None, typer.Argument(help="m, map")] = None,
    y: Annotated[float | None, typer.Argument(help="m, map")] = None,
    tolerance: Annotated[float, typer.Option(min=0.01, help="Reached within this, m.")] = 0.2,
    wait: Annotated[bool, typer.Option("--wait", help="Until it is reached or blocked.")] = False,
    cancel: Annotated[bool, typer.Option("--cancel", help="Forget the goal and stand.")] = False,
    robot: Robot_ = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Send the robot somewhere.

    Examples: `presage goal 15 1.5 --wait`; `presage goal --cancel`.
    """
    from common.messages import Goal, Pose  # noqa: PLC0415
    from presage.tools import give_goal  # noqa: PLC0415

    if not cancel and (x is None or y is None):
        raise UserError("a goal is two numbers, X Y in m (or --cancel)")
    wish = Goal(stamp_ns=0, pose=Pose(x=x or 0.0, y=y or 0.0), tolerance=tolerance, cancel=cancel)
    raise typer.Exit(give_goal(_link(connect, robot), wish, console, wait=wait))


@app.command()
def teleport(
    x: Annotated[float, typer.Argument(help="m, map")],
    y: Annotated[float, typer.Argument(help="m, map")],
    yaw: Annotated[float, typer.Argument(help="deg, counter-clockwise from x")] = 90.0,
    robot: Robot_ = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Carry the simulated robot off, unseen by its odometry.

    Example: `presage teleport 9 1.5`. The paper's preset knows one heading alone: 90 deg in corridor.
    """
    from common.messages import Pose  # noqa: PLC0415
    from presage.tools import teleport as carry  # noqa: PLC0415

    carry(_link(connect, robot), Pose(x=x, y=y, yaw=float(np.deg2rad(yaw))), console)


@app.command()
def localise(
    x: Annotated[float | None, typer.Argument(help="m, map; none: from the map's centre")] = None,
    y: Annotated[float | None, typer.Argument(help="m, map")] = None,
    robot: Robot_ = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Let the estimator begin anew, from a position or from nothing.

    Examples: `presage localise`; `presage localise 3 1.5`.
    """
    from presage.tools import localise as restart  # noqa: PLC0415

    restart(_link(connect, robot), x, y, console)


@app.command()
def record(
    out: Annotated[Path, typer.Option(help="Folder.")] = Path("recordings"),
    topics: Annotated[str, typer.Option(help="Comma-separated topic names; empty: all.")] = "",
    robot: Robot_ = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Record a running session to an MCAP file, until Ctrl-C.

    Examples: `presage record`; `presage record --out logs --topics scan,odom`.
    """
    from common.service import main as serve  # noqa: PLC0415
    from services.recorder.service import RecorderService  # noqa: PLC0415
    from services.recorder.settings import RecorderSettings  # noqa: PLC0415

    args = ["--directory", str(out), "--robot", robot, "--connect", connect]
    serve(RecorderSettings, RecorderService, args + (["--topics", topics] if topics else []))


@app.command()
def replay(
    file: Path,
    only: Annotated[str, typer.Option(help="Comma-separated topic names; empty: all but health.")] = "",
    rate: Annotated[
        float, typer.Option(min=0.0, help="1 is the original timing, 2 twice as fast, 0 as fast as it goes.")
    ] = 1.0,
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Put a recording's bytes back on their keys.

    Examples: `presage replay run.mcap --only scan,odom` (with `python -m services.estimator` beside it);
    `presage replay run.mcap --rate 4`.
    """
    from presage.replaying import run_replay  # noqa: PLC0415

    run_replay(file, _link(connect, "replay"), only, rate, console)


@app.command()
def plot(
    file: Path,
    out: Annotated[Path | None, typer.Option(help="PNG; none: beside the recording.")] = None,
    json_file: Json = None,
) -> None:
    """Draw a recording and print its summary.

    Example: `presage plot recordings/run.mcap --out run.png`.
    """
    from presage.demo import plot_command  # noqa: PLC0415

    plot_command(file, out or file.with_suffix(".png"), json_file, console)


@app.command()
def train(
    world: World_ = "corridor",
    preset: Annotated[str, typer.Option(help="paper.")] = "paper",
    scanner: Annotated[str, typer.Option(help="A known scanner.")] = "tim571",
    out: Annotated[Path, typer.Option(help="Folder for weights, card and curve.")] = Path("models"),
    beams: Annotated[int | None, typer.Option(min=2, help="Instead of the scanner's own number.")] = None,
    samples: Annotated[int, typer.Option(min=10)] = 13_000,
    epochs: Annotated[int, typer.Option(min=1)] = 60,
    batch: Annotated[int, typer.Option(min=1)] = 500,
    learning_rate: Annotated[float, typer.Option(min=1e-6)] = 3e-3,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    robot: Robot_ = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Learn to predict a scanner in a world. The same command takes an interrupted run up again.

    Samples come from the scanner on the bus where it is in this world, else from a simulator of its own.
    Examples: `presage train --world corridor --beams 622`; `presage train --world my.yaml --out trained --epochs 20`.
    """
    from presage.train import Job  # noqa: PLC0415
    from presage.train import train as learn  # noqa: PLC0415
    from services.estimator.training import Recipe  # noqa: PLC0415

    if preset != "paper":
        raise UserError(f"no preset {preset!r}: choose paper")
    recipe = Recipe(epochs=epochs, batch=batch, learning_rate=learning_rate, seed=seed)
    learn(Job(world, preset, scanner, beams, out, samples, recipe), _link(connect, robot), console)


@app.command()
def topics(robot: Robot_ = "robot") -> None:
    """The table of topics and queryables.

    Example: `presage topics`.
    """
    from presage.tools import list_topics  # noqa: PLC0415

    list_topics(robot, console)


@app.command()
def hz(
    topic: Annotated[str | None, typer.Argument(help="A topic; none: all.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1)] = 3.0,
    robot: Robot_ = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Measure rates on the bus.

    Examples: `presage hz`; `presage hz scan --seconds 10`.
    """
    from presage.tools import show_rates  # noqa: PLC0415

    raise typer.Exit(show_rates(_link(connect, robot), topic, seconds, console))


@app.command()
def echo(
    topic: str,
    count: Annotated[int, typer.Option("-n", "--count", min=0, help="End after so many; 0: Ctrl-C.")] = 0,
    full: Annotated[bool, typer.Option("--full", help="Long arrays whole.")] = False,
    robot: Robot_ = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Print a topic's messages, one JSON line each.

    Examples: `presage echo belief -n 1`; `presage echo scan --full -n 1 | jq .ranges`.
    """
    from presage.tools import echo as show  # noqa: PLC0415

    raise typer.Exit(show(_link(connect, robot), topic, count, console, full=full))


@app.command()
def doctor(
    seconds: Annotated[float, typer.Option(min=0.5, help="How long to listen.")] = 3.0,
    robot: Robot_ = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Find what is wrong with the installation or the running session.

    Example: `presage doctor`.
    """
    from presage.doctor import examine  # noqa: PLC0415

    raise typer.Exit(examine(_link(connect, robot), seconds, console))


@bench_app.command("latency")
def bench_latency(
    scans: Annotated[int, typer.Option(min=10)] = 300,
    rate: Annotated[float, typer.Option(min=1, max=1000, help="Scans a second.")] = 15.0,
    beams: Annotated[int, typer.Option(help="Beams of a scan.")] = 622,
    json_file: Json = None,
) -> None:
    """From scan to command through the real services, beside zenoh's own round trip of the same bytes.

    Example: `presage bench latency --json latency.json`.
    """
    from presage.bench import bench_latency as run  # noqa: PLC0415

    raise typer.Exit(run(scans, rate, beams, json_file, console))


@bench_app.command("localisation")
def bench_localisation(
    world: World_ = "corridor",
    beams: Annotated[int, typer.Option(help="Beams of a scan.")] = 622,
    trials: Annotated[int, typer.Option(min=1)] = 100,
    scans: Annotated[int, typer.Option(min=1, help="Fresh scans of each trial.")] = 25,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    json_file: Json = None,
) -> None:
    """How often preset paper finds a standing robot from the map's centre.

    Example: `presage bench localisation --trials 20`.
    """
    from presage.bench_localisation import bench_localisation as run  # noqa: PLC0415

    raise typer.Exit(run(world, beams, trials, scans, seed, json_file, console))


def main() -> None:
    """Entry point: one line for what a user can mend, status 2; 130 after Ctrl-C."""
    os.environ.setdefault("PYTHONWARNINGS", "default")
    try:
        with interruptible():
            app()
    except UserError as error:
        print(f"presage: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        with ignoring_interrupts():
            print("interrupted", file=sys.stderr)
        sys.exit(130)
