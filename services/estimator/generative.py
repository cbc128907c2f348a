"""What inference asks of a generative model, and the exact one: rays cast in the world itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from services.estimator import kernels

if TYPE_CHECKING:
    from common.se2 import Array
    from common.world import World

CORNER = 0.3  # rad, beyond which a surface is tilted by design and not by the ripples of learning
EXACT_SCALE = 1e-4  # m, what floating point and circles may leave


@dataclass(frozen=True)
class Expected:
    """The scans expected from N poses along B beams."""

    ranges: Array  # (N, B) m; +inf: no return expected
    scale: Array  # (N, B) m, standard deviation of the model's own error; log precision = -2 ln scale
    jacobian: Array  # (N, B, 3) derivative of the ranges by x, y (m/m) and yaw (m/rad) of the laser in map


class GenerativeModel(Protocol):
    """From poses of the laser to the scans expected there."""

    @property
    def ripple(self) -> float:
        """Standard deviation, rad, by which surfaces that are flat are predicted to be tilted: false information."""
        ...

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """Scans from laser poses (N, 3) in map along beams at angles (B,) rad in laser."""
        ...


@dataclass(frozen=True)
class RayCaster:
    """The world itself: the limit of any learning."""

    world: World
    ripple: float = 0.0

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """See GenerativeModel."""
        lasers, angles = np.asarray(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        shape = (len(lasers), len(angles))
        ranges, jacobian = np.empty(shape), np.empty((*shape, 3))
        kernels.cast(self.world.segments, self.world.circles, lasers, angles, ranges, jacobian)
        return Expected(ranges, np.full(shape, EXACT_SCALE), jacobian)
