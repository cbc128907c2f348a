"""Furniture of generated buildings, and the floor on which it stands."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import shapely

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.shapes import Box, Circle, Obstacle
from common.geometry.world import World
from common.robot.robot import Robot

Shape = Literal["box", "disc", "legs"]
Point = tuple[float, float]

ROBOT_RADIUS_M = Robot().radius
LEG_RADIUS_M = 0.02
GAP_M = 0.02  # between two pieces

# Shape, smallest and largest size in m, and whether it stands against a wall.
CATALOGUE: tuple[tuple[Shape, Point, Point, bool], ...] = (
    ("box", (0.8, 0.4), (1.6, 0.6), True),  # cupboard
    ("box", (0.8, 0.3), (2.0, 0.4), True),  # shelf
    ("box", (1.2, 0.7), (1.6, 0.8), True),  # desk
    ("box", (1.2, 0.7), (1.6, 0.8), False),
    ("box", (0.3, 0.3), (0.45, 0.45), False),  # column
    ("legs", (1.2, 0.7), (1.8, 0.9), False),  # table
    ("legs", (0.42, 0.42), (0.46, 0.46), False),  # chair
    ("legs", (0.42, 0.42), (0.46, 0.46), False),
    ("disc", (0.3, 0.3), (0.5, 0.5), True),  # plant
    ("disc", (0.2, 0.2), (0.3, 0.3), False),  # bin
)


@dataclass(frozen=True)
class FurniturePiece:
    """A piece of furniture as a laser sees it: a box, a disc, or four thin legs at the corners of a box."""

    shape: Shape
    size: tuple[float, float]  # m, of the box along its own x and y; of a disc, its diameter twice
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, m, rad, of the centre in map

    def at(self, pose: Array) -> FurniturePiece:
        """The same piece at another pose (3,)."""
        x, y, yaw = map(float, pose)
        return replace(self, pose=(x, y, yaw))

    @cached_property
    def box(self) -> Box:
        """The rectangle around the piece."""
        x, y, yaw = self.pose
        return Box(center=(x, y), size=self.size, yaw_deg=float(np.rad2deg(yaw)))

    @cached_property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The surfaces that beams hit."""
        if self.shape == "box":
            return (Obstacle(box=self.box),)
        if self.shape == "disc":
            return (Obstacle(circle=Circle(center=self.pose[:2], radius=self.size[0] / 2)),)
        inner = np.array(self.size) / 2 - LEG_RADIUS_M
        corners = se2.transform(self.pose, inner * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
        return tuple(Obstacle(circle=Circle(center=(x, y), radius=LEG_RADIUS_M)) for x, y in corners.tolist())

    @cached_property
    def footprint(self) -> shapely.Geometry:
        """The area that no other piece may overlap."""
        return self.obstacles[0].shape() if self.shape == "disc" else shapely.Polygon(self.box.corners())


class FloorSpace:
    """The floor of a building. Pieces are put down only where the robot can still reach every free place."""

    def __init__(self, walls: World, keep_free: shapely.Geometry) -> None:
        """``keep_free`` is the area in which nothing may stand, such as in front of doors."""
        self._empty = walls.free_space
        self._taken = keep_free
        self._reachable = shapely.buffer(self._empty, -ROBOT_RADIUS_M)
        self.pieces: list[FurniturePiece] = []

    def put(self, piece: FurniturePiece) -> bool:
        """Puts the piece down if there is room for it; returns whether there was."""
        if not shapely.covers(self._empty, piece.footprint) or shapely.intersects(self._taken, piece.footprint):
            return False
        surfaces = shapely.union_all([obstacle.shape() for obstacle in piece.obstacles])
        reachable = shapely.difference(self._reachable, shapely.buffer(surfaces, ROBOT_RADIUS_M, quad_segs=32))
        if not isinstance(reachable, shapely.Polygon) or reachable.is_empty:
            return False
        self._reachable = reachable
        self._taken = shapely.union(self._taken, shapely.buffer(piece.footprint, GAP_M))
        self.pieces.append(piece)
        return True
