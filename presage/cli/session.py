"""Commands for a running session: goal, teleport, topics, hz, top, doctor."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from common.bus.bus import DEFAULT_ENDPOINT
from common.errors import UserError
from common.geometry import se2
from common.limits import MAX_COORDINATE_M
from presage.terminal.options import Connect, Json, RobotName, WorldName, console, link_of

if TYPE_CHECKING:
    from common.messages.definitions import Pose

app = typer.Typer()


# A coordinate may be negative; a misspelt option still is no number.
NUMBERS = {"ignore_unknown_options": True}


@app.command(context_settings=NUMBERS)
def goal(
    x: Annotated[float | None, typer.Argument(help="m, map")] = None,
    y: Annotated[float | None, typer.Argument(help="m, map")] = None,
    yaw: Annotated[float | None, typer.Option(help="Heading there, deg; none: any.")] = None,
    tolerance: Annotated[float, typer.Option(min=0.01, help="Reached within this, m.")] = 0.2,
    wait: Annotated[bool, typer.Option("--wait", help="Until it is reached, refused, or blocked for 30 s.")] = False,
    cancel: Annotated[bool, typer.Option("--cancel", help="Forget the goal and stand.")] = False,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Send the robot somewhere.

    Examples: `presage goal 15 1.5 --wait`; `presage goal 15 1.5 --yaw 90`; `presage goal --cancel`.
    """
    from common.messages.definitions import Goal  # noqa: PLC0415
    from presage.live.commands import give_goal  # noqa: PLC0415

    if not cancel and (x is None or y is None):
        raise UserError("a goal is two numbers, X Y in m (or --cancel)")
    if not np.isfinite(tolerance):
        raise UserError(f"--tolerance {tolerance}: a finite number is needed, in m")
    # The time numbers it: the controller's status says which goal it is about, whoever gave the others.
    wish = Goal(
        stamp_ns=0, seq=time.time_ns(), pose=_pose(x or 0.0, y or 0.0, yaw or 0.0), tolerance=tolerance,
        yaw_tolerance=None if yaw is None else 0.1, cancel=cancel,
    )  # fmt: skip
    raise typer.Exit(give_goal(link_of(connect, robot), wish, console, wait=wait))


@app.command(context_settings=NUMBERS)
def teleport(
    x: Annotated[float, typer.Argument(help="m, map")],
    y: Annotated[float, typer.Argument(help="m, map")],
    yaw: Annotated[float, typer.Argument(help="deg, counter-clockwise from x")] = 90.0,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Carry the simulated robot off, unseen by its odometry.

    Example: `presage teleport 9 1.5`. The paper's preset knows one heading alone: 90 deg in corridor.
    """
    from presage.live.commands import teleport as carry  # noqa: PLC0415

    carry(link_of(connect, robot), _pose(x, y, yaw), console)


@app.command(context_settings=NUMBERS)
def localise(
    x: Annotated[float | None, typer.Argument(help="m, map; none: from the map's centre")] = None,
    y: Annotated[float | None, typer.Argument(help="m, map")] = None,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Let the estimator begin anew, from a position or from nothing.

    Examples: `presage localise`; `presage localise 3 1.5`.
    """
    from presage.live.commands import localise as restart  # noqa: PLC0415

    if (x is None) != (y is None):
        raise UserError("a position is two numbers, X Y in m")
    pose = _pose(x, y) if x is not None and y is not None else None
    restart(link_of(connect, robot), pose, console)


def _pose(x: float, y: float, yaw: float = 0.0) -> Pose:
    """From m and deg; raises UserError where a number is none."""
    from common.messages.definitions import Pose  # noqa: PLC0415

    if not np.isfinite([x, y, yaw]).all():
        given = f"{x:g} {y:g}" + (f" {yaw:g}" if yaw else "")
        raise UserError(f"{given}: a place is finite numbers, X Y in m (and for teleport YAW in deg)")
    if max(abs(x), abs(y)) > MAX_COORDINATE_M:
        raise UserError(f"{x:g} {y:g}: X and Y are within {MAX_COORDINATE_M:g} m of the origin")
    return Pose(x=x, y=y, yaw=float(se2.wrap(np.deg2rad(yaw))))


@app.command()
def topics(robot: RobotName = "robot") -> None:
    """The table of topics and queryables.

    Example: `presage topics`.
    """
    from presage.live.commands import list_topics  # noqa: PLC0415

    list_topics(robot, console)


@app.command()
def hz(
    topic: Annotated[str | None, typer.Argument(help="A topic; none: all.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1)] = 3.0,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Measure rates on the bus.

    Examples: `presage hz`; `presage hz scan --seconds 10`.
    """
    from presage.live.commands import show_rates  # noqa: PLC0415

    raise typer.Exit(show_rates(link_of(connect, robot), topic, seconds, console))


@app.command()
def top(
    robot: Annotated[
        list[str], typer.Option(envvar="PRESAGE_ROBOT", help="Which robot; may be given more than once.")
    ] = ["robot"],  # noqa: B006 - typer copies it
    once: Annotated[bool, typer.Option("--once", help="One table; status 1 where something is missing.")] = False,
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """The health of every service, live until Ctrl-C: rates, latency, drops, who is missing and how to start it.

    Examples: `presage top`; `presage top --once`; `presage top --robot one --robot two`.
    """
    from presage.diagnosis.top import run_top  # noqa: PLC0415

    raise typer.Exit(run_top(link_of(connect, robot[0]), list(dict.fromkeys(robot)), console, once=once))


@app.command()
def doctor(
    seconds: Annotated[float, typer.Option(min=0.5, help="How long to listen; frozen services show from 2.5 s.")] = 3.0,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
    world: WorldName = "corridor",
    recordings: Annotated[Path, typer.Option(help="Folder that recordings go to.")] = Path("recordings"),
    json_file: Json = None,
) -> None:
    """Find what is wrong with the installation, this machine, or the running session; status 1 where something is.

    Examples: `presage doctor`; `presage doctor --seconds 10 --json findings.json`; `presage doctor --world my.yaml`;
    `presage doctor --connect tcp/192.168.0.10:7447 --robot two`.
    """
    from presage.diagnosis.doctor import examine  # noqa: PLC0415

    link = link_of(connect, robot)
    raise typer.Exit(examine(link, seconds, console, world=world, recordings=recordings, json_file=json_file))
