"""Buildings with several floors: the floors' worlds side by side in one frame, `map`, as one world.

Each floor keeps the axes of its own frame, and the first floor its origin. Nothing connects the floors for a robot or
a beam, so being moved to another floor is a kidnapping like any other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field, ValidationError

from common.errors import UserError, first_fault
from common.geometry.floors import Floor, FloorName, Lift, translate_points, unknown_floor_message
from common.geometry.occupancy_grid import MAX_CELLS, UNKNOWN, OccupancyGrid
from common.geometry.shapes import Degrees, Obstacle, WorldName, WorldPart
from common.limits import Coordinate

if TYPE_CHECKING:
    from collections.abc import Mapping

    from common.geometry.world import World

GAP_M = 2.0  # between floors; their walls stop all beams
# Between ROS maps: more than the range of a scanner, because beams may leave a map through unknown cells.
GRID_GAP_M = 30.0

EXAMPLES = {  # by key, for error messages
    "floors": "floors: {ground: ground.yaml, first: first.yaml}",
    "lifts": "lifts: [{ground: [9, 1], first: [1, 1]}]",
    "start": "start: {floor: ground, x: 1.5, y: 1.5}",
    "name": "name: tower",
}


class FloorStart(WorldPart):
    """Initial pose of the robot in the frame of a floor."""

    floor: FloorName
    x: Coordinate  # m
    y: Coordinate  # m
    yaw_deg: Degrees = 0.0


class BuildingFile(WorldPart):
    """Contents of the YAML file of a building."""

    name: WorldName
    floors: Annotated[dict[FloorName, str], Field(min_length=1, max_length=100)]  # name of a world, or a file
    lifts: Annotated[list[Lift], Field(max_length=1000)] = []  # noqa: RUF012 - pydantic copies it
    start: FloorStart | None = None  # defaults to that of the first floor


def is_building(data: object) -> bool:
    """Whether the contents of a YAML file are those of a building, valid or not.

    A saved world with floors is not one; its floors have offsets.
    """
    if not isinstance(data, dict) or "floors" not in data:
        return False
    floors = data["floors"]
    return not (isinstance(floors, list) and all(isinstance(floor, dict) and "offset" in floor for floor in floors))


def read_building(data: dict[str, Any]) -> BuildingFile:
    """Validates the contents of a building's YAML file; raises UserError if they are invalid."""
    try:
        return BuildingFile.model_validate(data)
    except ValidationError as error:
        key = str(next(iter(error.errors(include_url=False)[0]["loc"]), ""))  # empty for an unknown key
        example = f"an example is {EXAMPLES[key]}" if key in EXAMPLES else None
        hint = example or "walls and obstacles belong in the files of its floors"
        raise UserError(f"{first_fault(error)}; {hint}") from None


def lay_out(building: BuildingFile, worlds: Mapping[str, World]) -> dict[str, Any]:
    """Fields of the World for a building, whose floors are ``worlds``; raises UserError if they cannot be combined."""
    first = next(iter(worlds.values()))
    for name, world in worlds.items():
        if world.floors:
            raise UserError(f"floor {name!r} is itself a building")
        if (world.grid is None) != (first.grid is None):
            raise UserError(f"floor {name!r}: either all floors must be ROS maps, or none")
    fields: dict[str, Any] = {}
    if first.grid is None:
        offsets = _polygon_offsets(worlds)
    else:
        fields["grid"], offsets = _combine_grids({name: world.grid for name, world in worlds.items() if world.grid})
    floors = {
        name: Floor(name=name, offset=offsets[name], boundary=translate_points(world.boundary, offsets[name]).tolist())
        for name, world in worlds.items()
    }
    start = building.start
    if start is None and first.start is not None:
        start = FloorStart(floor=next(iter(worlds)), **first.start.model_dump())
    if start is not None:
        fields["start"] = _start_in_map(start, floors)
    return {
        "name": building.name,
        **fields,
        "obstacles": [
            _obstacle_in_map(obstacle, name, offsets[name])
            for name, world in worlds.items()
            for obstacle in world.obstacles
        ],
        "floors": list(floors.values()),
        "lifts": building.lifts,
    }


def _start_in_map(start: FloorStart, floors: Mapping[str, Floor]) -> dict[str, float]:
    """Fields of the World's start."""
    if start.floor not in floors:
        raise UserError(f"start: {unknown_floor_message(start.floor, floors)}")
    floor = floors[start.floor]
    if (error := floor.placement_error((start.x, start.y))) is not None:
        raise UserError(f"start: {error}")
    x, y = floor.to_map((start.x, start.y)).tolist()
    return {"x": x, "y": y, "yaw_deg": start.yaw_deg}


def _polygon_offsets(worlds: Mapping[str, World]) -> dict[str, tuple[float, float]]:
    """Offsets in m, by name, that put floors without ROS maps side by side."""
    offsets: dict[str, tuple[float, float]] = {}
    right = 0.0  # m, the right edge of the previous floor
    for name, world in worlds.items():
        x0, _, x1, _ = world.bounds
        shift = right + GAP_M - x0 if offsets else 0.0
        offsets[name], right = (shift, 0.0), x1 + shift
    return offsets


def _combine_grids(grids: Mapping[str, OccupancyGrid]) -> tuple[OccupancyGrid, dict[str, tuple[float, float]]]:
    """One grid with the cells of all floors and unknown cells between them, and the floors' offsets in m by name."""
    first = next(iter(grids.values()))
    size = first.resolution
    for name, grid in grids.items():
        if not np.isclose(grid.resolution, size, rtol=1e-6, atol=0):
            raise UserError(
                f"floor {name!r}: its resolution of {grid.resolution:g} m differs from the {size:g} m of floor "
                f"{next(iter(grids))!r}; all floors must have the same one"
            )
        if grid.origin[2]:
            raise UserError(f"floor {name!r}: its map is rotated; the yaw must be 0")
    gap = round(GRID_GAP_M / size)
    ends = np.cumsum([grid.width + gap for grid in grids.values()]).tolist()
    width = ends[-1] - gap
    columns = [0, *ends[:-1]]  # first column of each floor
    rows = [round((grid.origin[1] - first.origin[1]) / size) for grid in grids.values()]
    low = min(rows)
    height = max(row + grid.height for row, grid in zip(rows, grids.values(), strict=True)) - low
    if width * height > MAX_CELLS:
        raise UserError(f"the floors side by side are {width} x {height} cells, which is more than {MAX_CELLS}")
    values = np.full((height, width), UNKNOWN, np.uint8)
    x, y = first.origin[:2]
    offsets = {}
    for (name, grid), column, row in zip(grids.items(), columns, rows, strict=True):
        values[row - low : row - low + grid.height, column : column + grid.width] = grid.values
        offsets[name] = (x + column * size - grid.origin[0], y + row * size - grid.origin[1])
    return OccupancyGrid.of(values, size, (x, y + low * size, 0.0)), offsets


def _obstacle_in_map(obstacle: Obstacle, floor: str, offset: tuple[float, float]) -> dict[str, Any]:
    """Fields of a floor's obstacle, moved to map and with the floor's name before its own."""
    fields = obstacle.model_dump(exclude_none=True)
    if obstacle.polygon is not None:
        fields["polygon"] = translate_points(obstacle.polygon, offset).tolist()
    elif obstacle.box is not None:
        fields["box"]["center"] = translate_points(obstacle.box.center, offset).tolist()
    elif obstacle.circle is not None:
        fields["circle"]["center"] = translate_points(obstacle.circle.center, offset).tolist()
    if obstacle.name:
        fields["name"] = f"{floor}/{obstacle.name}"
    return fields
