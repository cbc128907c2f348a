"""`presage goal`, `explore`, `teleport`, `relocalise`, `save-map` and `save-model`."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from common.errors import UserError
from common.geometry import se2
from common.limits import MAX_COORDINATE_M
from presage.cli.session_options import chosen_link
from presage.terminal.options import CommandWithNumbers, console, number

if TYPE_CHECKING:
    from common.messages.definitions import Pose

app = typer.Typer()

MAX_HEADING_DEG = 360  # a larger one is probably a mistake, such as a coordinate in its place

Floor = Annotated[
    str, typer.Option(help="Floor in whose frame the place is (docs/maps.md). Defaults to the frame of the whole map.")
]


@app.command(
    cls=CommandWithNumbers,
    rich_help_panel="Drive",
    short_help="Send the robot to a goal, or cancel it.",
)
def goal(
    context: typer.Context,
    x: Annotated[float | None, typer.Argument(parser=number, help="x of the goal in the map, m.")] = None,
    y: Annotated[float | None, typer.Argument(parser=number, help="y of the goal in the map, m.")] = None,
    yaw: Annotated[
        float | None, typer.Argument(parser=number, help="Heading at the goal, deg. Defaults to any heading.")
    ] = None,
    tolerance: Annotated[
        float, typer.Option(min=0.001, help="Distance at which the goal counts as reached, m.")
    ] = 0.02,
    yaw_tolerance: Annotated[float, typer.Option(min=0.1, max=180, help="Tolerance of the heading, deg.")] = 5.7,
    approach: Annotated[
        float | None, typer.Option(help="Direction of motion over the last 0.6 m, deg. Defaults to any direction.")
    ] = None,
    floor: Floor = "",
    wait: Annotated[
        bool, typer.Option("--wait", help="Wait until the goal is reached, refused, or without progress for 30 s.")
    ] = False,
    cancel: Annotated[bool, typer.Option("--cancel", help="Cancel the current goal and stop the robot.")] = False,
) -> None:
    """Send the robot to a goal, or cancel its goal.

    Examples: `presage goal 15 1.5 --wait`; `presage goal 15 1.5 90`; `presage goal --cancel`; in a building with floors
    `presage goal 3 2 --floor first`. To dock within 3 mm and
    0.5 degrees: `presage goal 15 1.5 90 --approach 90 --tolerance 0.003 --yaw-tolerance 0.5`.
    """
    from common.messages.definitions import Goal
    from presage.live.commands import send_goal

    if cancel and x is not None:
        raise UserError("--cancel cancels the current goal, whichever it is: leave out the place")
    if not cancel and (x is None or y is None):
        raise UserError("a goal is two numbers, X Y in m (or --cancel)")
    if approach is not None and not abs(approach) <= MAX_HEADING_DEG:
        raise UserError(f"--approach {approach:g}: give a direction from -{MAX_HEADING_DEG} to {MAX_HEADING_DEG} deg")
    if not np.isfinite(tolerance):
        raise UserError(f"--tolerance {tolerance}: a finite number is needed, in m")
    # The time as sequence number distinguishes this goal from those of other clients in the controller's status.
    request = Goal(
        stamp_ns=0,
        seq=time.time_ns(),
        pose=_pose(x or 0.0, y or 0.0, yaw or 0.0),
        tolerance=tolerance,
        yaw_tolerance=None if yaw is None else float(np.deg2rad(yaw_tolerance)),
        approach=None if approach is None else float(se2.wrap(np.deg2rad(approach))),
        cancel=cancel,
        map_id=floor,
    )
    raise typer.Exit(send_goal(chosen_link(context), request, console, wait=wait))


@app.command(rich_help_panel="Drive", short_help="Explore an unknown building, and return to the start.")
def explore(context: typer.Context) -> None:
    """Explore the building that the mapper maps, until all that can be reached is mapped and the robot is back.

    Shows the mapped area and the length of the path. Ctrl-C stops the robot. Goals sent meanwhile take precedence.

    Example: `presage up --world office --mapping`, then in another terminal `presage explore`.
    """
    from presage.live.exploring import explore as run

    raise typer.Exit(run(chosen_link(context), console))


@app.command(cls=CommandWithNumbers, rich_help_panel="Drive", short_help="Move the simulated robot elsewhere.")
def teleport(
    context: typer.Context,
    x: Annotated[float, typer.Argument(parser=number, help="x in the map, m.")],
    y: Annotated[float, typer.Argument(parser=number, help="y in the map, m.")],
    yaw: Annotated[float, typer.Argument(parser=number, help="Heading, deg, counter-clockwise from x.")] = 90.0,
    floor: Floor = "",
) -> None:
    """Move the simulated robot to another place, without any trace in its odometry.

    Example: `presage teleport 9 1.5`. Preset paper can only localise at the heading it was trained for, 90 deg in
    corridor.
    """
    from presage.live.commands import teleport as run

    run(chosen_link(context), _pose(x, y, yaw), console, floor=floor)


@app.command(
    cls=CommandWithNumbers,
    rich_help_panel="Drive",
    short_help="Restart localisation, near a position or globally.",
)
def relocalise(
    context: typer.Context,
    x: Annotated[
        float | None,
        typer.Argument(
            parser=number,
            help="x in the map, m. Defaults to a search of the whole map (preset paper: its initial pose).",
        ),
    ] = None,
    y: Annotated[float | None, typer.Argument(parser=number, help="y in the map, m.")] = None,
    yaw: Annotated[float | None, typer.Argument(parser=number, help="Heading, deg. Defaults to any heading.")] = None,
    floor: Floor = "",
) -> None:
    """Reset the estimator and localise again, near a given position or globally; print the state and pose found.

    Waits up to 10 s for state tracking, and exits with status 1 without it. `presage echo belief -n 1` prints the
    present belief.

    Examples: `presage relocalise`; `presage relocalise 3 1.5`; `presage relocalise 3 1.5 90`.
    """
    from presage.live.commands import relocalise as run

    if (x is None) != (y is None):
        raise UserError("a position is two numbers, X Y in m")
    if floor and x is None:
        raise UserError("--floor needs a position on the floor, X Y in m")
    pose = _pose(x, y, yaw or 0.0) if x is not None and y is not None else None
    raise typer.Exit(run(chosen_link(context), pose, console, heading_known=yaw is not None, floor=floor))


@app.command("save-map", rich_help_panel="Drive", short_help="Save the map that is being built.")
def save_map(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the map: letters, digits, - and _.")],
) -> None:
    """Save the map of `presage up --mapping` as a ROS map, NAME.yaml and .pgm, with the trajectory NAME.tum.

    The mapper writes into its own folder (its setting `maps`), by default the one where the session was started.

    Example: `presage save-map my-floor`.
    """
    from presage.live.commands import save_map as run

    run(chosen_link(context), name, console)


@app.command("save-model", rich_help_panel="Drive", short_help="Save the model that is learned while driving.")
def save_model(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the model: letters, digits, - and _.")],
) -> None:
    """Save what the estimator of `presage up --learn` has learned, as NAME-precise.safetensors with a card, .json.

    The estimator writes into its own folder (its setting `saved_models`), by default the one where the session was
    started.

    Example: `presage save-model monday`, then `presage up --world my.yaml --model monday-precise.safetensors`.
    """
    from presage.live.commands import save_model as run

    run(chosen_link(context), name, console)


def _pose(x: float, y: float, yaw: float = 0.0) -> Pose:
    """A pose from m and deg; raises UserError if a value is not finite or too large."""
    from common.messages.definitions import Pose

    if not np.isfinite([x, y, yaw]).all():
        given = f"{x:g} {y:g}" + (f" {yaw:g}" if yaw else "")
        raise UserError(f"{given}: a place is finite numbers, X Y in m and YAW in deg")
    if max(abs(x), abs(y)) > MAX_COORDINATE_M:
        raise UserError(f"{x:g} {y:g}: X and Y must be within {MAX_COORDINATE_M:g} m of the origin")
    if abs(yaw) > MAX_HEADING_DEG:
        raise UserError(f"{x:g} {y:g} {yaw:g}: YAW must be from -{MAX_HEADING_DEG} to {MAX_HEADING_DEG} deg")
    return Pose(x=x, y=y, yaw=float(se2.wrap(np.deg2rad(yaw))))
