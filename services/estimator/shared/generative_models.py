"""The GenerativeModel protocol, and the exact model that casts rays in the world."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from common.geometry.ray_casting import cast_rays_with_jacobian

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from services.estimator.shared.asking import Pieces

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

    @classmethod
    def joined(cls, parts: Sequence[Expected]) -> Expected:
        """Concatenates the scans of several parts."""
        return cls(
            np.concatenate([part.ranges for part in parts]),
            np.concatenate([part.scale for part in parts]),
            np.concatenate([part.jacobian for part in parts]),
        )


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


@dataclass(frozen=True)
class Expect:
    """`GenerativeModel.expect` as a question (see `services.estimator.shared.asking`)."""

    model: GenerativeModel
    lasers: Array  # (N, 3)
    angles: Array  # (B,)

    @property
    def alike(self) -> Hashable:
        """Questions to one model about the same beams can be answered together."""
        return id(self.model), self.angles.tobytes()

    @property
    def beams(self) -> int:
        """Number of beams to predict."""
        return len(self.lasers) * len(self.angles)

    def answer(self) -> Expected:
        """Returns the predicted scans."""
        return self.model.expect(self.lasers, self.angles)

    def answer_all(self, questions: Sequence[Expect]) -> list[Expected]:
        """Answers several questions with one call of the model."""
        expected = self.model.expect(np.concatenate([question.lasers for question in questions]), self.angles)
        ends = np.cumsum([len(question.lasers) for question in questions])
        return [expected.part(slice(end - len(q.lasers), end)) for q, end in zip(questions, ends, strict=True)]

    def in_pieces(self, beams: int) -> Pieces[Expected]:
        """Predicts a few poses at a time."""
        rows = max(1, beams // max(1, len(self.angles)))
        parts = []
        for begin in range(0, len(self.lasers), rows):
            if begin:
                yield
            parts.append(self.model.expect(self.lasers[begin : begin + rows], self.angles))
        return Expected.joined(parts)
