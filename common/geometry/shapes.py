"""Furniture as data: polygons, boxes and circles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import shapely
from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.errors import NAME_PATTERN, unknown_key
from common.limits import Coordinate, PositiveDistance

if TYPE_CHECKING:
    from common.geometry.se2 import Array

CIRCLE_SEGMENTS = 64  # per quarter circle in free space; the error is 0.04 mm at a radius of 0.5 m

WorldName = Annotated[str, Field(min_length=1, max_length=200, pattern=NAME_PATTERN)]
Degrees = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Point = tuple[Coordinate, Coordinate]
Ring = Annotated[list[Point], Field(min_length=3, max_length=10_000)]


class WorldPart(BaseModel):
    """Base of the parts of a world: immutable, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _explain_unknown_key(cls, data: Any) -> Any:
        if isinstance(data, dict) and (unknown := [key for key in data if key not in cls.model_fields]):
            raise ValueError(unknown_key(str(unknown[0]), cls.model_fields))
        return data


class Box(WorldPart):
    """A rectangle."""

    center: Point  # m
    size: tuple[PositiveDistance, PositiveDistance]  # m, along its own x and y
    yaw_deg: Degrees = 0.0

    def corners(self) -> Array:
        """(4, 2) m, counter-clockwise."""
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(self.size) / 2
        yaw = np.deg2rad(self.yaw_deg)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        return np.asarray(half @ turn.T + np.array(self.center))


class Circle(WorldPart):
    """A disc."""

    center: Point  # m
    radius: PositiveDistance  # m


class Obstacle(WorldPart):
    """One piece of furniture: exactly one of polygon, box, circle."""

    name: Annotated[str, Field(max_length=200)] = ""
    polygon: Ring | None = None  # m, corners in order
    box: Box | None = None
    circle: Circle | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> Obstacle:
        if sum(shape is not None for shape in (self.polygon, self.box, self.circle)) != 1:
            raise ValueError("an obstacle is exactly one of polygon, box, circle")
        if self.polygon is not None:
            check_ring(self.polygon)
        return self

    def ring(self) -> Array | None:
        """(V, 2) corners in m, or None for a circle."""
        if self.polygon is not None:
            return np.array(self.polygon)
        return self.box.corners() if self.box is not None else None

    def shape(self) -> shapely.Geometry:
        """The area it covers."""
        if self.circle is not None:
            return shapely.Point(self.circle.center).buffer(self.circle.radius, quad_segs=CIRCLE_SEGMENTS)
        return shapely.Polygon(self.ring())


def check_ring(ring: list[tuple[float, float]]) -> None:
    """Raises ValueError if the corners, in order, do not form a simple polygon."""
    polygon = shapely.Polygon(ring)
    if not polygon.is_valid or polygon.area <= 0:
        raise ValueError(f"the polygon is not simple: {shapely.is_valid_reason(polygon)}")
