"""`presage obstacle`: furniture of a running simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from pydantic import ValidationError

from common.errors import UserError, first_fault
from presage.cli.session_options import chosen_link
from presage.session.running_sessions import OBSERVER
from presage.terminal.options import CommandWithNumbers, console, number

if TYPE_CHECKING:
    from common.geometry.world import Obstacle

app = typer.Typer(
    help="List, add, move and remove obstacles in a running simulator. They are not in the robot's map.",
    no_args_is_help=True,
)

Name = Annotated[str, typer.Argument(help="Name of the obstacle.")]
X = Annotated[float, typer.Argument(parser=number, help="x of the obstacle's centre in the map, m.")]
Y = Annotated[float, typer.Argument(parser=number, help="y of the obstacle's centre in the map, m.")]
Size = Annotated[tuple[float, float], typer.Option(help="Length and width of the box, m.")]
Yaw = Annotated[float, typer.Option(help="Orientation of the box, deg.")]
Radius = Annotated[float, typer.Option(help="Radius of a round obstacle, m. 0 makes a box.")]


@app.command(cls=CommandWithNumbers)
def add(
    context: typer.Context,
    name: Name,
    x: X,
    y: Y,
    size: Size = (0.5, 0.5),
    yaw: Yaw = 0.0,
    radius: Radius = 0.0,
) -> None:
    """Add an obstacle.

    Examples: `presage obstacle add crate 6 1.5`; `presage obstacle add door 4 2 --size 0.9 0.05 --yaw 90`;
    `presage obstacle add pillar 6 1 --radius 0.2`.
    """
    _change(context, "add", name, _shape(x, y, size, yaw, radius))


@app.command(cls=CommandWithNumbers)
def move(context: typer.Context, name: Name, x: X, y: Y) -> None:
    """Move an obstacle; it keeps its shape and orientation.

    Example: `presage obstacle move crate 6 2`.
    """
    obstacles = {each.name: each for each in _obstacles(context)}
    if name not in obstacles:
        raise UserError(f"there is no obstacle {name!r} (there: {', '.join(obstacles) or 'none'})")
    _change(context, "move", name, _moved(obstacles[name], x, y))


@app.command()
def remove(context: typer.Context, name: Name) -> None:
    """Remove an obstacle; furniture of the world file can be removed too.

    Example: `presage obstacle remove crate`.
    """
    _change(context, "remove", name, None)


@app.command("list")
def list_(context: typer.Context) -> None:
    """List the obstacles of the simulator with their shapes. Those without a name in the world file have numbers.

    Example: `presage obstacle list`.
    """
    for obstacle in _obstacles(context):
        shape = obstacle.model_dump_json(exclude={"name"}, exclude_none=True)
        console.print(f"{obstacle.name}: {shape}", markup=False, highlight=False, soft_wrap=True)


def _obstacles(context: typer.Context) -> list[Obstacle]:
    from common.messages.requests import Request, WorldReply
    from common.messages.topics import WORLD
    from presage.live.latest_messages import session_bus

    with session_bus(chosen_link(context, OBSERVER)) as bus:
        reply = bus.query(WORLD, Request(), WorldReply)
    if reply.world is None:
        hidden = "the simulator hides its world while mapping: obstacles can be added and removed, not listed or moved"
        raise UserError(f"refused: {reply.reason}" if reply.reason else hidden)
    return list(reply.world.obstacles)


def _moved(obstacle: Obstacle, x: float, y: float) -> Obstacle:
    """The obstacle with its centre at (x, y) m; a polygon's is the mean of its corners."""
    if obstacle.polygon is not None:
        by_x, by_y = np.subtract((x, y), np.mean(obstacle.polygon, axis=0))
        return obstacle.model_copy(update={"polygon": [(px + by_x, py + by_y) for px, py in obstacle.polygon]})
    kind, shape = ("circle", obstacle.circle) if obstacle.circle is not None else ("box", obstacle.box)
    assert shape is not None  # noqa: S101 - an obstacle has exactly one shape
    return obstacle.model_copy(update={kind: shape.model_copy(update={"center": (x, y)})})


def _shape(x: float, y: float, size: tuple[float, float], yaw: float, radius: float) -> Obstacle:
    from common.geometry.world import Obstacle

    centre = {"center": (x, y)}
    shape = {"circle": {**centre, "radius": radius}} if radius else {"box": {**centre, "size": size, "yaw_deg": yaw}}
    try:
        return Obstacle.model_validate(shape)
    except ValidationError as error:
        raise UserError(f"the obstacle: {first_fault(error)}") from None


def _change(context: typer.Context, action: str, name: str, obstacle: Obstacle | None) -> None:
    from common.messages.requests import ObstacleRequest, Reply
    from common.messages.topics import OBSTACLE
    from presage.live.latest_messages import session_bus

    try:
        request = ObstacleRequest.model_validate({"action": action, "name": name, "obstacle": obstacle})
    except ValidationError as error:
        raise UserError(f"obstacle {name!r}: {first_fault(error)}") from None
    with session_bus(chosen_link(context)) as bus:
        reply = bus.query(OBSTACLE, request, Reply)
    if not reply.ok:
        raise UserError(f"refused: {reply.reason}")
    done = {"add": "added", "move": "moved", "remove": "removed"}[action]
    console.print(f"{name}: {done}; the map of the estimator and the controller is unchanged")
