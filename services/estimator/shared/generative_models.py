"""The GenerativeModel protocol, and the exact model that casts rays in the world."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from services.estimator.shared import grid_ray_kernels as cell_kernels
from services.estimator.shared import kernels

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from services.estimator.shared.asking import Pieces

CORNER = 0.3  # rad, beyond which a surface is tilted by design and not by the ripples of learning
EXACT_SCALE = 1e-4  # m, what floating point and circles may leave


@dataclass(frozen=True)
class Expected:
    """The scans expected from N poses along B beams."""

    ranges: Array  # (N, B) m; +inf: no return expected
    scale: Array  # (N, B) m, standard deviation of the model's own error; log precision = -2 ln scale
    jacobian: Array  # (N, B, 3) derivative of the ranges by x, y (m/m) and yaw (m/rad) of the laser in map

    def part(self, rows: slice) -> Expected:
        """Of some of the poses."""
        return Expected(self.ranges[rows], self.scale[rows], self.jacobian[rows])

    @classmethod
    def joined(cls, parts: Sequence[Expected]) -> Expected:
        """Several below one another."""
        return cls(
            np.concatenate([part.ranges for part in parts]),
            np.concatenate([part.scale for part in parts]),
            np.concatenate([part.jacobian for part in parts]),
        )


class GenerativeModel(Protocol):
    """From poses of the laser to the scans expected there."""

    @property
    def ripple(self) -> float:
        """Standard deviation, rad, by which surfaces that are flat are predicted to be tilted: false information."""
        ...

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """Scans from laser poses (N, 3) in map along beams at angles (B,) rad in laser."""
        ...


def map_error(world: World) -> float:
    """Standard deviation, m, of real surfaces from where the world has them: half a cell of a ROS map, else 0.

    The surface lies anywhere in the cell, and a mapping has rounded its poses and walls besides.
    """
    return 0.0 if world.grid is None else 0.5 * world.grid.resolution


@dataclass(frozen=True)
class RayCaster:
    """The world itself: the limit of any learning. The cells of a ROS map are known to half a cell."""

    world: World
    ripple: float = 0.0

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """See GenerativeModel."""
        lasers, angles = np.asarray(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        shape = (len(lasers), len(angles))
        ranges, jacobian = np.empty(shape), np.empty((*shape, 3))
        world = self.world
        kernels.cast(world.outlines, world.circles, lasers, angles, ranges, jacobian)
        if (grid := world.grid) is not None:
            rays, size = grid.shapes.rays, grid.resolution
            first = grid.to_map(np.array([-size, -size]))  # rays have a frame of empty cells around the map
            frame = np.array([*first, grid.origin[2], size])
            cell_kernels.cast_cells(rays.occupied, rays.clear, frame, lasers, angles, ranges, jacobian)
        return Expected(ranges, np.full(shape, max(EXACT_SCALE, map_error(world))), jacobian)


@dataclass(frozen=True)
class Expect:
    """The question an estimator asks most (see `asking`): the scans expected from N poses. Answered by Expected."""

    model: GenerativeModel
    lasers: Array  # (N, 3)
    angles: Array  # (B,)

    @property
    def alike(self) -> Hashable:
        """One model, the same beams."""
        return id(self.model), self.angles.tobytes()

    @property
    def beams(self) -> int:
        """N B."""
        return len(self.lasers) * len(self.angles)

    def answer(self) -> Expected:
        """Now."""
        return self.model.expect(self.lasers, self.angles)

    def answer_all(self, questions: Sequence[Expect]) -> list[Expected]:
        """All poses in one call of the model."""
        seen = self.model.expect(np.concatenate([question.lasers for question in questions]), self.angles)
        ends = np.cumsum([len(question.lasers) for question in questions])
        return [seen.part(slice(end - len(q.lasers), end)) for q, end in zip(questions, ends, strict=True)]

    def in_pieces(self, beams: int) -> Pieces[Expected]:
        """A few poses at a time."""
        rows = max(1, beams // max(1, len(self.angles)))
        parts = []
        for begin in range(0, len(self.lasers), rows):
            if begin:
                yield
            parts.append(self.model.expect(self.lasers[begin : begin + rows], self.angles))
        return Expected.joined(parts)
