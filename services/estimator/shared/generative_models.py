"""The GenerativeModel protocol, and the exact model that casts rays in the world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from common.errors import UserError
from common.geometry.ray_casting import cast_rays, cast_rays_with_jacobian
from services.estimator.shared.seen_cells import SeenCells

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from common.geometry.world import World

PASSED_M = 1e-3  # distance behind a surface from which a ray is continued, so that it does not hit the same surface
EXACT_SCALE_M = 1e-4  # standard deviation stated for exact rays: their rounding errors


@dataclass(frozen=True)
class Expected:
    """Scans predicted at N laser poses along B beams."""

    ranges: Array  # (N, B) m; +inf if no return is expected
    scale: Array  # (N, B) m, standard deviation of the model's error; +inf where the model knows nothing
    jacobian: Array  # (N, B, 3) derivative of the ranges by the laser's x, y (m/m) and yaw (m/rad) in map

    def __post_init__(self) -> None:
        """Raises UserError if the shapes differ, because compiled loops do not check their indices."""
        shapes = [getattr(each, "shape", None) for each in (self.ranges, self.scale, self.jacobian)]
        if shapes[0] is None or len(shapes[0]) != 2 or shapes != [shapes[0], shapes[0], (*shapes[0], 3)]:
            raise UserError(
                "model: give Expected arrays for N poses and B beams: ranges (N, B), scale (N, B) and jacobian "
                f"(N, B, 3), not of shapes {', '.join(map(str, shapes))}"
            )

    @property
    def slope(self) -> Array:
        """Derivative (N, B) of the ranges by the distance to the surface: 1 / cosine of the angle of incidence."""
        return np.asarray(np.hypot(self.jacobian[..., 0], self.jacobian[..., 1]))

    def moved_back(self, offset: float) -> Expected:
        """Returns the scans if all surfaces were ``offset`` m farther back, perpendicular to themselves."""
        return replace(self, ranges=self.ranges + offset * self.slope) if offset else self

    def part(self, rows: slice) -> Expected:
        """Returns the scans at some of the poses."""
        return Expected(self.ranges[rows], self.scale[rows], self.jacobian[rows])

    def beams(self, first: int, end: int) -> Expected:
        """Returns the scans with only the beams ``first`` to ``end`` - 1."""
        return Expected(self.ranges[:, first:end], self.scale[:, first:end], self.jacobian[:, first:end])


class GenerativeModel(Protocol):
    """Predicts scans at poses of the laser."""

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """Predicts scans at laser poses (N, 3) in map, along beams at ``angles`` (B,) rad in the laser frame."""
        ...

    def expect_behind(self, lasers: Array, angles: Array, ranges: Array) -> Array:
        """Ranges (N, B) in m to the next surface behind those at ``ranges`` (N, B) m; +inf if there is none.

        A beam ends there if the first surface was removed.
        """
        ...


def check_model(model: GenerativeModel, places: Array) -> None:
    """Raises UserError if a model does not return what GenerativeModel states, for the laser at ``places`` (N, 2) m."""
    for method in ("expect", "expect_behind"):
        if not hasattr(model, method):
            raise UserError(
                f"model: give an object with the methods expect and expect_behind of GenerativeModel, not {model!r}"
            )
    lasers, angles = np.column_stack([places, np.zeros(len(places))]), np.linspace(-1, 1, 5)
    expected = model.expect(lasers, angles)
    if not isinstance(expected, Expected):
        raise UserError(f"model: expect must return presage.Expected, not {type(expected).__name__}")
    shape, behind = (len(lasers), len(angles)), model.expect_behind(lasers, angles, expected.ranges)
    for method, values in (("expect", expected.ranges), ("expect_behind", behind)):
        if np.shape(values) != shape:
            raise UserError(f"model: {method} must return ranges (N, B), here {shape}, not of shape {np.shape(values)}")
        if not (np.asarray(values) >= 0).all():
            raise UserError(f"model: {method} returned NaN or negative ranges; no return is +inf")
    if not (expected.scale >= 0).all() or not np.isfinite(expected.jacobian).all():
        raise UserError(
            "model: the scale of expect must not be negative or NaN (unknown is +inf), and its jacobian must be finite "
            "(0 without a return)"
        )


@dataclass(frozen=True)
class RayCaster:
    """The exact model, which casts rays in the world: the limit of what learning can reach.

    In an occupancy grid, nothing is known about what lies behind unknown cells.
    """

    world: World
    offset: float = 0.0  # m, distance of the real surfaces behind those of the world, as in a map of cells

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """Predicts scans; see GenerativeModel."""
        lasers, angles = np.array(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        ranges, jacobian = cast_rays_with_jacobian(self.world, lasers, angles)
        # A laser cannot be inside an object, so an object of the map around it must have been removed.
        inside = self.world.surface_distance(lasers[:, :2]) < 0
        inside[inside] = ~self._in_circle(lasers[inside])
        if inside.any():
            rays = _advanced(lasers[inside, None], angles, ranges[inside] + PASSED_M)
            further, derivatives = cast_rays_with_jacobian(self.world, rays.reshape(-1, 3), np.zeros(1))
            further, derivatives = further.reshape(rays.shape[:2]), derivatives.reshape(rays.shape)
            ranges[inside] += PASSED_M + further
            hits = np.isfinite(further)
            derivatives[hits, 2] *= ranges[inside][hits] / np.maximum(further[hits], PASSED_M)
            jacobian[inside] = derivatives
        expected = Expected(ranges, np.full(ranges.shape, EXACT_SCALE_M), jacobian).moved_back(self.offset)
        if self._seen is not None:
            self._seen.limit(lasers, angles, expected.ranges, expected.jacobian, expected.scale)
        return expected

    def expect_behind(self, lasers: Array, angles: Array, ranges: Array) -> Array:
        """Ranges to the next surface; see GenerativeModel."""
        lasers, angles = np.asarray(lasers, float).reshape(-1, 3), np.asarray(angles, float)
        behind = np.array(ranges, float)
        pose, beam = np.nonzero(np.isfinite(behind))
        lasers, angles, start = lasers[pose], angles[beam], behind[pose, beam] + PASSED_M
        rays = _advanced(lasers, angles, start)
        # Continue from the far side of the object that was hit.
        start += np.where(self._in_circle(rays), 0.0, cast_rays(self.world, rays, np.zeros(1))[:, 0] + PASSED_M)
        behind[pose, beam] = start + cast_rays(self.world, _advanced(lasers, angles, start), np.zeros(1))[:, 0]
        return behind

    @cached_property
    def _seen(self) -> SeenCells | None:
        return SeenCells.of_world(self.world)

    def _in_circle(self, poses: Array) -> npt.NDArray[np.bool_]:
        """Mask (N,) of the poses (N, 3) in a circle, which rays from inside do not hit."""
        inside = np.zeros(len(poses), np.bool_)
        for x, y, radius in self.world.circles:
            inside |= np.hypot(poses[:, 0] - x, poses[:, 1] - y) < radius
        return inside


def _advanced(lasers: Array, angles: Array, distances: Array) -> Array:
    """Poses (..., 3) of beams from laser poses (..., 3), each ``distances`` (...) m along its own direction."""
    heading = lasers[..., 2] + angles
    ahead = np.where(np.isfinite(distances), distances, 0.0)
    x, y = lasers[..., 0] + ahead * np.cos(heading), lasers[..., 1] + ahead * np.sin(heading)
    return np.stack([x, y, heading], axis=-1)
