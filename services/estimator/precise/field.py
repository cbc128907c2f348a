"""The generative model: a learned distance field that predicts ranges.

The field phi (m) is positive in free space and zero on surfaces. It is stored on a square grid and interpolated
bilinearly. A beam from p in direction u ends where phi(p + r u) = 0, found by sphere tracing (Hart 1996, "Sphere
tracing"). The derivative of the range is that of the implicit function: dr = -(n . dp + r n . u' dyaw) / (n . u), with
n the gradient of phi.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from common.geometry.grid_values import values_at
from services.estimator.precise.field_tracing import mark_crossed, trace, trace_behind
from services.estimator.shared.generative_models import Expected
from services.estimator.shared.seen_cells import SEEN_CELL_M

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.shared.seen_cells import SeenCells

Floats = npt.NDArray[np.float32]

# Beams are divided into classes of about equal prediction error, by these edges: how close the beam passed another
# surface (m), how deep the surface is behind the beam's end, relative to a plane, and the cosine of incidence.
CLEARANCE_EDGES = np.array([0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1])
DEPTH_RATIO_EDGES = np.array([0.0, 0.25, 0.5, 0.75])
COS_INCIDENCE_EDGES = np.array([0.05, 0.1, 0.2, 0.5])
SOLID_DIRECTIONS = 360  # of beams that find out what is solid
SOLID_MARGIN_CELLS = 2  # a node this near to such a beam is free: the beams leave gaps
CLASSES = (len(CLEARANCE_EDGES) + 1, len(DEPTH_RATIO_EDGES) + 1, len(COS_INCIDENCE_EDGES) + 1)


@dataclass(frozen=True)
class TracedBeams:
    """Traced beams: arrays (N, B) for N laser poses and B beams."""

    ranges: Array  # m; +inf if nothing is met within the grid
    jacobian: Array  # (N, B, 3) derivative of the ranges by x, y (m/m) and yaw (m/rad) of the laser
    clearance: Array  # m, smallest distance at which the beam passed another surface; +inf if it passed none
    depth_ratio: Array  # depth behind the end, relative to a plane: 1 on a wall, near 0 at an edge
    cos_incidence: Array  # cosine of incidence

    def classes(self) -> npt.NDArray[np.intp]:
        """Index (N, B) of each beam's class in the table of scales."""
        parts = (
            np.digitize(self.clearance, CLEARANCE_EDGES),
            np.digitize(self.depth_ratio, DEPTH_RATIO_EDGES),
            np.digitize(self.cos_incidence, COS_INCIDENCE_EDGES),
        )
        return np.ravel_multi_index(parts, CLASSES)


@dataclass(frozen=True)
class DistanceField:
    """The field phi on a grid, whose node (i, j) lies at origin + resolution * (j, i)."""

    phi: Floats  # (ny, nx) m
    origin: tuple[float, float]  # m in map, of node (0, 0)
    resolution: float  # m

    def value_at(self, places: Array) -> Array:
        """Phi (N,) in m at the node nearest to each place (N, 2) m in map; NaN beyond the grid."""
        column, row = np.round((places - self.origin) / self.resolution).astype(int).T
        return values_at(self.phi, row, column, np.nan)

    def as_stored(self) -> DistanceField:
        """The field rounded to half precision, as it is stored, so that it can be evaluated with the same precision."""
        return dataclasses.replace(self, phi=self.phi.astype(np.float16).astype(np.float32))

    def with_solids(self, places: Array) -> DistanceField:
        """The field, negative wherever no beam from ``places`` (S, 2) m passes.

        Learning gives the inside of thick things a positive distance, because no beam has ever been there.
        """
        crossed = np.zeros(self.phi.shape, np.bool_)
        lasers = np.column_stack([places, np.zeros(len(places))])
        directions = np.linspace(0.0, 2 * np.pi, SOLID_DIRECTIONS, endpoint=False)
        mark_crossed(self.phi, *self.origin, self.resolution, lasers, directions, crossed)
        solid = ~ndimage.binary_dilation(crossed, iterations=SOLID_MARGIN_CELLS)
        return dataclasses.replace(self, phi=np.where(solid, -np.abs(self.phi), self.phi))

    def trace(self, lasers: Array, angles: Array) -> TracedBeams:
        """Traces beams from laser poses (N, 3) in map along angles (B,) rad in the laser frame."""
        lasers, angles = np.asarray(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        shape = (len(lasers), len(angles))
        ranges, clearance, depth_ratio, cos_incidence = (np.empty(shape) for _ in range(4))
        jacobian = np.empty((*shape, 3))
        trace(
            self.phi,
            *self.origin,
            self.resolution,
            lasers,
            angles,
            ranges,
            jacobian,
            clearance,
            depth_ratio,
            cos_incidence,
        )
        return TracedBeams(ranges, jacobian, clearance, depth_ratio, cos_incidence)

    def trace_behind(self, lasers: Array, angles: Array, ranges: Array) -> Array:
        """Ranges (N, B) in m to the next surface behind the one at ``ranges`` (N, B) m; +inf if there is none."""
        lasers, angles = np.asarray(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        behind = np.empty(ranges.shape)
        trace_behind(self.phi, *self.origin, self.resolution, lasers, angles, ranges, behind)
        return behind

    def nodes_in(self, seen: SeenCells) -> npt.NDArray[np.bool_]:
        """Mask (ny, nx) of the nodes that lie in seen cells."""
        i, j = (
            np.clip(((start + self.resolution * np.arange(n) - seen_start) / SEEN_CELL_M).astype(int), 0, m - 1)
            for start, seen_start, n, m in zip(
                self.origin[::-1], seen.origin[::-1], self.phi.shape, seen.cells.shape, strict=True
            )
        )
        return seen.cells[np.ix_(i, j)]


@dataclass(frozen=True)
class FieldModel:
    """A generative model: a distance field with a learned precision for each class of beams."""

    field: DistanceField
    # m, standard deviation of the prediction error in each class
    scales: Array = dataclasses.field(default_factory=lambda: np.full(int(np.prod(CLASSES)), 1e-3))
    seen: SeenCells | None = None  # None if the whole grid counts as seen

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """Predicts scans; see GenerativeModel."""
        traced = self.field.trace(lasers, angles)
        scale = self.scales[traced.classes()]
        if self.seen is not None:
            self.seen.limit(lasers, angles, traced.ranges, traced.jacobian, scale)
        return Expected(traced.ranges, scale, traced.jacobian)

    def expect_behind(self, lasers: Array, angles: Array, ranges: Array) -> Array:
        """Ranges to the next surface; see GenerativeModel."""
        return self.field.trace_behind(lasers, angles, ranges)
