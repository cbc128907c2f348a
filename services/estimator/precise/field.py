"""The generative model: a learned distance field that predicts ranges.

The field phi (m) is positive in free space and zero on surfaces, stored on a square grid and interpolated bilinearly.
A beam from p in direction u ends where phi(p + r u) = 0, found by sphere tracing (Hart 1996, "Sphere tracing"), so the
range's derivative is that of the implicit function: dr = -(n . dp + r n . u' dyaw) / (n . u), n the gradient of phi.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from services.estimator.shared import kernels
from services.estimator.shared.generative_models import Expected

if TYPE_CHECKING:
    from common.geometry.se2 import Array

Floats = npt.NDArray[np.float32]

# Edges of the classes of beams that are predicted alike well: how close the beam passed by another surface (m), how
# deep behind its end the surface still lies, relative to a plane, and the cosine of incidence.
DIP_EDGES = np.array([0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1])
DEPTH_EDGES = np.array([0.0, 0.25, 0.5, 0.75])
FACING_EDGES = np.array([0.05, 0.1, 0.2, 0.5])
SEEN_CELL = 0.2  # m: neighbouring beams must not leave gaps between them
CLASSES = (len(DIP_EDGES) + 1, len(DEPTH_EDGES) + 1, len(FACING_EDGES) + 1)


@dataclass(frozen=True)
class Traced:
    """What beams (N, B) meet."""

    ranges: Array  # m; +inf: nothing within the grid
    jacobian: Array  # (N, B, 3) by x, y (m/m) and yaw (m/rad) of the laser
    dip: Array  # m, nearest pass by another surface; +inf: none
    edge: Array  # depth behind the end relative to a plane: 1 on a wall, near 0 at an edge
    facing: Array  # cosine of incidence

    def classes(self) -> npt.NDArray[np.intp]:
        """(N, B) index into the table of scales."""
        parts = (
            np.digitize(self.dip, DIP_EDGES), np.digitize(self.edge, DEPTH_EDGES),
            np.digitize(self.facing, FACING_EDGES),
        )  # fmt: skip
        return np.ravel_multi_index(parts, CLASSES)


@dataclass(frozen=True)
class DistanceField:
    """phi on a grid: node (i, j) lies at origin + resolution * (j, i)."""

    phi: Floats  # (ny, nx) m
    origin: tuple[float, float]  # m in map, of node (0, 0)
    resolution: float  # m

    def trace(self, lasers: Array, angles: Array) -> Traced:
        """From laser poses (N, 3) in map along angles (B,) rad in laser."""
        lasers, angles = np.asarray(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        shape = (len(lasers), len(angles))
        ranges, dip, edge, facing = (np.empty(shape) for _ in range(4))
        jacobian = np.empty((*shape, 3))
        kernels.trace(self.phi, *self.origin, self.resolution, lasers, angles, ranges, jacobian, dip, edge, facing)
        return Traced(ranges, jacobian, dip, edge, facing)


@dataclass(frozen=True)
class Seen:
    """Cells of a square grid that a beam of the samples has passed: of the others nothing is known."""

    cells: npt.NDArray[np.bool_]  # (ny, nx); cell (i, j) begins at origin + SEEN_CELL * (j, i)
    origin: tuple[float, float]  # m in map

    def at(self, field: DistanceField) -> npt.NDArray[np.bool_]:
        """(ny, nx) for the nodes of a field."""
        ny, nx = field.phi.shape
        i, j = (
            np.clip(((start + field.resolution * np.arange(n) - own) / SEEN_CELL).astype(int), 0, m - 1)
            for start, own, n, m in zip(field.origin[::-1], self.origin[::-1], (ny, nx), self.cells.shape, strict=True)
        )
        return self.cells[np.ix_(i, j)]

    def contains(self, points: Array) -> npt.NDArray[np.bool_]:
        """(N,) whether somebody has looked there; points (N, 2) m in map."""
        j, i = np.floor((points - self.origin) / SEEN_CELL).astype(int).T
        inside = (i >= 0) & (j >= 0) & (i < self.cells.shape[0]) & (j < self.cells.shape[1])
        found = np.zeros(len(points), np.bool_)
        found[inside] = self.cells[i[inside], j[inside]]
        return found

    def limit(self, lasers: Array, angles: Array, ranges: Array, jacobian: Array, scale: Array) -> None:
        """Let beams (N, B) end where they enter what nobody has seen, with an infinite scale."""
        lasers, angles = np.asarray(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        kernels.unseen(self.cells, *self.origin, SEEN_CELL, lasers, angles, SEEN_CELL, ranges, jacobian, scale)


@dataclass(frozen=True)
class FieldModel:
    """A distance field with learned precision."""

    field: DistanceField
    scales: Array = dataclasses.field(
        default_factory=lambda: np.full(int(np.prod(CLASSES)), 1e-3)
    )  # m, error of each class

    ripple: float = 0.0  # rad, see GenerativeModel
    seen: Seen | None = None  # where somebody has looked; none: everywhere

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """See GenerativeModel."""
        traced = self.field.trace(lasers, angles)
        scale = self.scales[traced.classes()]
        if self.seen is not None:
            self.seen.limit(lasers, angles, traced.ranges, traced.jacobian, scale)
        return Expected(traced.ranges, scale, traced.jacobian)
