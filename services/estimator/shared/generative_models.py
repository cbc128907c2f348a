"""The GenerativeModel protocol, and the exact model that casts rays in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from common.geometry.ray_casting import cast_rays_with_jacobian

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World

CORNER_ANGLE_RAD = 0.3  # a surface tilted by more is a corner, and not a ripple caused by learning
EXACT_SCALE_M = 1e-4  # stated error of exact rays, for rounding


@dataclass(frozen=True)
class Expected:
    """Scans predicted at N laser poses along B beams."""

    ranges: Array  # (N, B) m; +inf if no return is expected
    scale: Array  # (N, B) m, standard deviation of the model's error; +inf where the model knows nothing
    jacobian: Array  # (N, B, 3) derivative of the ranges by the laser's x, y (m/m) and yaw (m/rad) in map

    def part(self, rows: slice) -> Expected:
        """Returns the scans at some of the poses."""
        return Expected(self.ranges[rows], self.scale[rows], self.jacobian[rows])


class GenerativeModel(Protocol):
    """Predicts scans at poses of the laser."""

    @property
    def ripple(self) -> float:
        """Standard deviation in rad of the normals that the model predicts for flat surfaces.

        Such ripples look like information about the position along a wall, but they are errors.
        """
        ...

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """Predicts scans at laser poses (N, 3) in map, along beams at ``angles`` (B,) rad in the laser frame."""
        ...


def map_error(world: World) -> float:
    """Standard deviation in m of the surfaces in a world: half a cell of a ROS map, else 0.

    The real surface may be anywhere in the cell, and mapping adds rounding errors of poses and walls.
    """
    return 0.0 if world.grid is None else 0.5 * world.grid.resolution


@dataclass(frozen=True)
class RayCaster:
    """The exact model, which casts rays in the world: the limit of what learning can reach.

    Surfaces of a ROS map are known to half a cell.
    """

    world: World
    ripple: float = 0.0

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """Predicts scans; see GenerativeModel."""
        ranges, jacobian = cast_rays_with_jacobian(self.world, lasers, angles)
        return Expected(ranges, np.full(ranges.shape, max(EXACT_SCALE_M, map_error(self.world))), jacobian)
