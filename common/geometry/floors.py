"""The floors of a building and its lifts.

All floors lie side by side in one frame, `map` (see `building`), so a point belongs to at most one of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.errors import NAME_PATTERN
from common.geometry.shapes import Point, Ring, WorldPart, check_ring

if TYPE_CHECKING:
    from collections.abc import Iterable

    from common.geometry.se2 import Array

FloorName = Annotated[str, Field(min_length=1, max_length=100, pattern=NAME_PATTERN, coerce_numbers_to_str=True)]
# Place in m of a lift on each floor at which it stops, in the floor's frame
Lift = Annotated[dict[FloorName, Point], Field(min_length=2, max_length=100)]


class Floor(WorldPart):
    """One floor of a building."""

    name: FloorName
    offset: Point  # m, origin of the floor's frame in map; the axes are parallel
    boundary: Ring  # m in map, the floor's walls; with a grid, the edge of its cells

    @model_validator(mode="after")
    def _boundary_is_simple(self) -> Floor:
        check_ring(self.boundary)
        return self

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 in m in map of the boundary's bounding box."""
        return bounds_of(self.boundary)

    def contains(self, place: npt.ArrayLike) -> bool:
        """Whether a point (2,) or pose (3,) in map is within this floor's bounding box."""
        x0, y0, x1, y1 = self.bounds
        x, y = np.asarray(place, float)[:2]
        return bool(x0 <= x <= x1 and y0 <= y <= y1)

    def to_map(self, places: npt.ArrayLike) -> Array:
        """Transforms points (..., 2) or poses (..., 3) from the floor's frame to map."""
        return translate_points(places, self.offset)

    def from_map(self, places: npt.ArrayLike) -> Array:
        """Transforms points (..., 2) or poses (..., 3) from map to the floor's frame."""
        return translate_points(places, (-self.offset[0], -self.offset[1]))

    def placement_error(self, places: npt.ArrayLike) -> str | None:
        """The reason why points (N, 2) or poses (N, 3) in the floor's frame are not all on it, or None if they are."""
        for place in np.atleast_2d(places):
            if not self.contains(self.to_map(place)):  # it may be on a neighbouring floor in map
                edges = self.from_map(np.reshape(self.bounds, (2, 2)))
                (x0, y0), (x1, y1) = (np.round(edges, 2) + 0.0).tolist()
                where = f"which reaches from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) m"
                return f"({place[0]:g}, {place[1]:g}) is not on floor {self.name!r}, {where}"
        return None


def floor_at(floors: Iterable[Floor], place: npt.ArrayLike) -> Floor | None:
    """The floor whose bounding box contains a point (2,) or pose (3,) in map, or None."""
    return next((floor for floor in floors if floor.contains(place)), None)


def place_text(floors: Iterable[Floor], place: npt.ArrayLike, decimals: int = 2) -> str:
    """A point (2,) or pose (3,) in map for messages to users: its coordinates in the frame of its floor, and the floor.

    Of a place that is on no floor, the coordinates in map.
    """
    floor = floor_at(floors, place)
    position = np.asarray(place, float) if floor is None else floor.from_map(place)
    x, y = np.round(position, decimals)[:2] + 0.0  # no -0.00
    return f"({x:.{decimals}f}, {y:.{decimals}f})" + ("" if floor is None else f" on floor {floor.name!r}")


def unknown_floor_message(name: str, floors: Iterable[str]) -> str:
    """The message for an unknown floor ``name``."""
    return f"there is no floor {name!r}: choose one of {', '.join(floors)}"


def check_floors(floors: list[Floor], lifts: list[dict[str, tuple[float, float]]]) -> None:
    """Raises ValueError if names of floors are not unique, or lifts are not on their floors."""
    known = {floor.name: floor for floor in floors}
    if len(known) < len(floors):
        raise ValueError("two floors have the same name")
    for number, lift in enumerate(lifts, 1):
        for name, place in lift.items():
            if name not in known:
                raise ValueError(f"lift {number}: {unknown_floor_message(name, known)}")
            if (error := known[name].placement_error(place)) is not None:
                raise ValueError(f"lift {number}: {error}")


def bounds_of(points: npt.ArrayLike) -> tuple[float, float, float, float]:
    """x0, y0, x1, y1 of the bounding box of points (N, 2)."""
    (x0, y0), (x1, y1) = np.min(points, axis=0), np.max(points, axis=0)
    return float(x0), float(y0), float(x1), float(y1)


def corners_of(bounds: tuple[float, float, float, float]) -> list[tuple[float, float]]:
    """The corners of a bounding box, counter-clockwise."""
    x0, y0, x1, y1 = bounds
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def translate_points(places: npt.ArrayLike, offset: tuple[float, float]) -> Array:
    """Points (..., 2) or poses (..., 3) moved by an offset in m."""
    result = np.array(places, float)
    result[..., :2] += offset
    return result
