"""Options used by several commands."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from common.bus.bus import Link
from common.bus.security import Credentials, credentials
from common.robot.scanner import SCANNERS
from common.runtime.config import split_endpoints

# Nobody's terminal is 80 columns wide when it is a pipe.
console = Console(width=None if sys.stdout.isatty() else 150)

# Where standard output is the result.
err_console = Console(stderr=True, width=None if sys.stderr.isatty() else 150)

RobotName = Annotated[str, typer.Option(envvar="PRESAGE_ROBOT", help="Which robot.")]
Connect = Annotated[str, typer.Option(envvar="PRESAGE_CONNECT", help="The session's zenoh endpoint(s).")]
WorldName = Annotated[
    str, typer.Option(envvar="PRESAGE_WORLD", help="A shipped world, a world file, or a ROS map.yaml.")
]
Port = Annotated[int, typer.Option(min=0, max=65535, help="The router's port on 127.0.0.1; 0: any free one.")]
Seed = Annotated[int, typer.Option(min=0, max=2**31, help="Of all that is drawn.")]
Json = Annotated[Path | None, typer.Option("--json", help="Write the numbers there.")]


ScannerName = Annotated[str, typer.Option(help=f"{', '.join(SCANNERS)}, or a file (docs/scanners.md).")]
MountText = Annotated[
    str, typer.Option("--mount", help="Of the laser in base_link: x,y[,yaw_deg] (m, deg); none: the scanner's own.")
]
UpsideDown = Annotated[bool, typer.Option("--upside-down", help="The laser hangs with a roll of 180 deg.")]
Beams = Annotated[int | None, typer.Option(min=2, help="Instead of the scanner's own number; 622 are the paper's.")]

EstimatorName = Annotated[
    str, typer.Option(envvar="PRESAGE_ESTIMATOR", help="precise, paper, particle-filter or amcl-defaults.")
]
ModelName = Annotated[str, typer.Option(help="Of precise: learned, exact (the world itself), or a file of weights.")]
PriorName = Annotated[str, typer.Option(help="Of motion between scans: motion (scans alone), odometry, command.")]


People = Annotated[
    int, typer.Option(min=0, max=100, envvar="PRESAGE_PEOPLE", help="How many walk about, unknown to the map.")
]
PeopleSpeed = Annotated[
    float, typer.Option(min=0.0, max=3.0, envvar="PRESAGE_PEOPLE_SPEED", help="Of their walk, m/s.")
]
StartPose = Annotated[
    str,
    typer.Option(envvar="PRESAGE_START", help="Where the robot stands at first: x,y[,yaw_deg]; none: the world's own."),
]
DriveName = Annotated[
    str, typer.Option("--drive", envvar="PRESAGE_DRIVE", help="Of the robot: holonomic or differential.")
]
Radius = Annotated[
    float | None,
    typer.Option(envvar="PRESAGE_RADIUS", help="Of the robot, m; none: 0.27. It stays that far from walls."),
]
MaxSpeed = Annotated[
    float | None, typer.Option(envvar="PRESAGE_MAX_SPEED", help="Of the robot, m/s; none: 1. No command is faster.")
]
MaxTurn = Annotated[
    float | None, typer.Option(envvar="PRESAGE_MAX_TURN", help="Of the robot, rad/s; none: 2. No command turns faster.")
]
Acceleration = Annotated[
    float | None,
    typer.Option(envvar="PRESAGE_ACCELERATION", help="With which it gains speed and surely brakes, m/s²; none: 1."),
]
TurnAcceleration = Annotated[
    float | None,
    typer.Option(envvar="PRESAGE_TURN_ACCELERATION", help="The same of turning, rad/s²; none: 3."),
]
Viewer = Annotated[bool, typer.Option(help="Serve the live page.")]
OpenPage = Annotated[bool, typer.Option("--open/--no-open", help="Open the page, where there is a display.")]


Security = Annotated[
    Path | None, typer.Option(envvar="PRESAGE_SECURITY", help="Folder of credentials (`presage secure init`).")
]
RoleName = Annotated[
    str,
    typer.Option(envvar="PRESAGE_ROLE", help="Whose credentials of that folder; none: those that suit the command."),
]
LOOKING_ON = frozenset({"echo", "hz", "top", "doctor"})  # commands for which an observer's credentials do


def robot_arguments(
    drive: str, radius: float | None, max_speed: float | None, max_turn: float | None, acceleration: float | None,
    turn_acceleration: float | None,
) -> tuple[str, ...]:  # fmt: skip
    """Of every service that moves the robot or holds it back; what is None is theirs to know."""
    given = {
        "radius": radius, "max-speed": max_speed, "max-turn": max_turn, "acceleration": acceleration,
        "turn-acceleration": turn_acceleration,
    }  # fmt: skip
    return ("--drive", drive, *(f"--{name}={value}" for name, value in given.items() if value is not None))


@dataclass(frozen=True)
class Asked:
    """The running command and its `--security` and `--role`."""

    command: str
    security: Path | None = None
    role: str = ""


asked: ContextVar[Asked] = ContextVar("asked", default=Asked(""))  # noqa: B039 - frozen


def link_of(connect: str, robot: str, *suiting: str) -> Link:
    """The session these options name; ``suiting`` as in `credentials_for`."""
    return replace(Link(), robot=robot, connect=split_endpoints(connect), security=credentials_for(robot, *suiting))


def credentials_for(robot: str, *suiting: str) -> Credentials | None:
    """Of the running command: those named with `--role`, else the first of ``suiting``, or of those that suit it."""
    now = asked.get()
    if now.security is None:
        return None
    if now.role:
        return credentials(now.security, (now.role,), robot)
    usual = ("observer", "operator") if now.command in LOOKING_ON else ("operator",)
    return credentials(now.security, suiting or usual, robot)


def with_options(
    run: Callable[..., Any], command: Callable[..., Any], added: Sequence[tuple[str, Any, Any]], without: str = ""
) -> Callable[..., Any]:
    """``run``, which wraps ``command``, with that one's parameters but ``without``, and (name, type, default) added."""
    before = signature(command, eval_str=True)
    parameters = [
        *(each for each in before.parameters.values() if each.name != without),
        *(Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind) for name, kind, default in added),
    ]
    run.__signature__ = before.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run
