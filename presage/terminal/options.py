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

# Rich assumes 80 columns when the output is not a terminal, which would wrap tables and long lines.
console = Console(width=None if sys.stdout.isatty() else 150)

# For commands whose result goes to standard output: progress and messages go to standard error.
err_console = Console(stderr=True, width=None if sys.stderr.isatty() else 150)

RobotName = Annotated[str, typer.Option(envvar="PRESAGE_ROBOT", help="Robot name.")]
Connect = Annotated[
    str,
    typer.Option(envvar="PRESAGE_CONNECT", help="Zenoh endpoints of the session, separated by commas."),
]
WorldName = Annotated[str, typer.Option(envvar="PRESAGE_WORLD", help="World name, world file, or ROS map.yaml.")]
Port = Annotated[
    int, typer.Option(min=0, max=65535, help="TCP port of the router on 127.0.0.1. 0 chooses a free port.")
]
Seed = Annotated[int, typer.Option(min=0, max=2**31, help="Random seed.")]
Json = Annotated[Path | None, typer.Option("--json", help="Also write the results to this JSON file.")]


ScannerName = Annotated[
    str, typer.Option(help=f"Scanner model ({', '.join(SCANNERS)}) or a scanner file (docs/scanners.md).")
]
MountText = Annotated[
    str,
    typer.Option(
        "--mount",
        help="Pose of the laser in base_link, x,y[,yaw_deg], in m and deg. Defaults to the mount of the scanner.",
    ),
]
UpsideDown = Annotated[
    bool, typer.Option("--upside-down", help="The laser is mounted upside down (with a roll of 180 deg).")
]
Beams = Annotated[
    int | None,
    typer.Option(min=2, help="Beams per scan. Defaults to the scanner's own number. The paper uses 622."),
]

EstimatorName = Annotated[
    str,
    typer.Option(
        envvar="PRESAGE_ESTIMATOR", help="Estimator preset: precise, paper, particle-filter or amcl-defaults."
    ),
]
ModelName = Annotated[
    str,
    typer.Option(
        help="Generative model of preset precise: learned, exact (computed from the world), or a file of weights."
    ),
]
PriorName = Annotated[
    str, typer.Option(help="What predicts the motion between scans: motion (earlier scans only), odometry or command.")
]


People = Annotated[
    int,
    typer.Option(
        min=0, max=100, envvar="PRESAGE_PEOPLE", help="Number of simulated people walking about; the map omits them."
    ),
]
PeopleSpeed = Annotated[
    float,
    typer.Option(min=0.0, max=3.0, envvar="PRESAGE_PEOPLE_SPEED", help="Walking speed of simulated people, m/s."),
]
StartPose = Annotated[
    str,
    typer.Option(
        envvar="PRESAGE_START",
        help="Start pose of the robot, x,y[,yaw_deg], in m and deg. Defaults to the world's start pose.",
    ),
]
DriveName = Annotated[
    str, typer.Option("--drive", envvar="PRESAGE_DRIVE", help="Drive of the robot: holonomic or differential.")
]
Radius = Annotated[
    float | None,
    typer.Option(
        envvar="PRESAGE_RADIUS", help="Radius of the robot, m; it keeps at least this distance to walls. Default: 0.27."
    ),
]
MaxSpeed = Annotated[
    float | None, typer.Option(envvar="PRESAGE_MAX_SPEED", help="Maximum speed of the robot, m/s. Default: 1.")
]
MaxTurn = Annotated[
    float | None, typer.Option(envvar="PRESAGE_MAX_TURN", help="Maximum turn rate of the robot, rad/s. Default: 2.")
]
Acceleration = Annotated[
    float | None,
    typer.Option(
        envvar="PRESAGE_ACCELERATION", help="Maximum acceleration, and guaranteed deceleration, m/s². Default: 1."
    ),
]
TurnAcceleration = Annotated[
    float | None,
    typer.Option(
        envvar="PRESAGE_TURN_ACCELERATION",
        help="Maximum angular acceleration, and guaranteed angular deceleration, rad/s². Default: 3.",
    ),
]
Viewer = Annotated[bool, typer.Option(help="Serve the live page.")]
OpenPage = Annotated[bool, typer.Option("--open/--no-open", help="Open the live page in a browser, if there is one.")]


Security = Annotated[
    Path | None,
    typer.Option(envvar="PRESAGE_SECURITY", help="Folder of credentials, made with `presage secure init`."),
]
RoleName = Annotated[
    str,
    typer.Option(
        envvar="PRESAGE_ROLE", help="Role whose credentials are used. Defaults to one that allows the command."
    ),
]
READ_ONLY_COMMANDS = frozenset({"echo", "hz", "top", "doctor"})  # an observer's credentials suffice for these


def robot_arguments(
    drive: str,
    radius: float | None,
    max_speed: float | None,
    max_turn: float | None,
    acceleration: float | None,
    turn_acceleration: float | None,
) -> tuple[str, ...]:
    """Command-line arguments that describe the robot to its services; a limit that is None keeps the default."""
    limits = {
        "radius": radius,
        "max-speed": max_speed,
        "max-turn": max_turn,
        "acceleration": acceleration,
        "turn-acceleration": turn_acceleration,
    }
    return ("--drive", drive, *(f"--{name}={value}" for name, value in limits.items() if value is not None))


@dataclass(frozen=True)
class Invocation:
    """The running command and its `--security` and `--role`."""

    command: str
    security: Path | None = None
    role: str = ""


invocation: ContextVar[Invocation] = ContextVar("invocation", default=Invocation(""))  # noqa: B039 - frozen


def link_of(connect: str, robot: str, *preferred_roles: str) -> Link:
    """Link to the session that these options name; ``preferred_roles`` as in `credentials_for`."""
    security = credentials_for(robot, *preferred_roles)
    return replace(Link(), robot=robot, connect=split_endpoints(connect), security=security)


def credentials_for(robot: str, *preferred_roles: str) -> Credentials | None:
    """Returns the credentials for the running command, or None without `--security`.

    `--role` takes precedence. Otherwise the first of ``preferred_roles`` with credentials in the folder is used; it
    defaults to operator, and for commands that only read, to observer and then operator.
    """
    current = invocation.get()
    if current.security is None:
        return None
    if current.role:
        return credentials(current.security, (current.role,), robot)
    default_roles = ("observer", "operator") if current.command in READ_ONLY_COMMANDS else ("operator",)
    return credentials(current.security, preferred_roles or default_roles, robot)


def with_options(
    run: Callable[..., Any], command: Callable[..., Any], added: Sequence[tuple[str, Any, Any]], without: str = ""
) -> Callable[..., Any]:
    """Gives the wrapper ``run`` the signature of ``command``, from which typer derives the options.

    ``added`` lists additional parameters as (name, type, default); the parameter named ``without`` is left out.
    """
    original = signature(command, eval_str=True)
    parameters = [
        *(each for each in original.parameters.values() if each.name != without),
        *(Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind) for name, kind, default in added),
    ]
    run.__signature__ = original.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run
