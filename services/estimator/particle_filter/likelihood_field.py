"""The likelihood field model (Thrun et al. 2005, chapter 6.4)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.errors import UserError

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from common.geometry.world import World

    Single = npt.NDArray[np.float32]

MAX_CELLS = 20_000_000  # 320 MB, about 20 s to build


class SurfaceDistances:
    """Signed distance to the nearest visible surface, exact at the nodes of a grid and interpolated between them.

    Surfaces are the boundary of free space; if all occupied cells of a wall counted, the belief would be drawn into the
    wall. Inside walls the distance is negative, so that it has no kink at a surface, which interpolation would round
    off.
    """

    def __init__(self, world: World, resolution: float = 0.05, max_dist: float = 2.0) -> None:
        """``resolution`` is the distance of nodes in m, ``max_dist`` m is where the distance saturates.

        Raises UserError if there are too many nodes.
        """
        x0, y0, x1, y1 = world.bounds
        self.resolution, self.max_dist = resolution, max_dist
        # With this margin every point beyond the grid can be clipped to its edge, where the distance is max_dist.
        self.origin = np.array([x0, y0]) - max_dist - resolution
        self.shape = (
            int(np.ceil((x1 - x0 + 2 * max_dist) / resolution)) + 3,
            int(np.ceil((y1 - y0 + 2 * max_dist) / resolution)) + 3,
        )
        if self.shape[0] * self.shape[1] > MAX_CELLS:
            raise UserError(
                f"world {world.name!r}: {self.shape[0]} x {self.shape[1]} cells of {resolution} m are too many "
                f"for a likelihood field; give a coarser resolution"
            )
        x = self.origin[0] + resolution * np.arange(self.shape[0])
        y = self.origin[1] + resolution * np.arange(self.shape[1])
        nodes = world.surface_distance_on_lattice(x, y, max_dist).T
        # In a cell d = a + b u + c v + e u v, with u and v in [0, 1). The four numbers are stored side by side, so that
        # each point needs one memory access.
        a, right, up, both = nodes[:-1, :-1], nodes[1:, :-1], nodes[:-1, 1:], nodes[1:, 1:]
        self._cells: Single = np.stack([a, right - a, up - a, both - right - up + a], -1).astype(np.float32)
        self._cells = self._cells.reshape(-1, 4)

    def __call__(self, x: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> Single:
        """Signed distance in m at points x, y (...) m in map, at most max_dist; negative inside and behind walls."""
        u = (x - self.origin[0]).astype(np.float32) * np.float32(1 / self.resolution)
        v = (y - self.origin[1]).astype(np.float32) * np.float32(1 / self.resolution)
        nx, ny = self.shape
        np.clip(u, 0, nx - 1.001, out=u)
        np.clip(v, 0, ny - 1.001, out=v)
        i, j = u.astype(np.int32), v.astype(np.int32)
        u -= i
        v -= j
        cell = self._cells.take((i * np.int32(ny - 1) + j).ravel(), axis=0).reshape(*u.shape, 4)
        return np.asarray(cell[..., 0] + u * cell[..., 1] + v * (cell[..., 2] + u * cell[..., 3]))


class LikelihoodField:
    """p(z | pose) = z_hit N(d; 0, sigma) + z_rand / range_max for the distance d of a beam's end to a surface.

    For a beam perpendicular to a wall it integrates over the range to z_hit + z_rand. Beams without return, or too
    close, have no end point and are left out, as in AMCL.
    """

    def __init__(self, field: SurfaceDistances, z_hit: float, z_rand: float) -> None:
        """``field`` is that of the world, z_hit and z_rand are the weights of a hit and of an unexplained range."""
        self.field, self.z_hit, self.z_rand = field, z_hit, z_rand

    def ends(self, poses: Array, ranges: Array, angles: Array) -> Single:
        """Signed distances (N, B) in m from the ends of beams (B,) to a surface, for scanner poses (N, 3) in map."""
        bx, by = (ranges * np.cos(angles)).astype(np.float32), (ranges * np.sin(angles)).astype(np.float32)
        cos, sin = np.cos(poses[:, 2:3]).astype(np.float32), np.sin(poses[:, 2:3]).astype(np.float32)
        x, y = poses[:, 0:1].astype(np.float32), poses[:, 1:2].astype(np.float32)
        return self.field(x + cos * bx - sin * by, y + sin * bx + cos * by)

    def densities(self, distances: npt.NDArray[np.floating], sigma: float, range_max: float) -> Single:
        """Density in 1/m of beams that end ``distances`` (...) m from a surface; sigma and range_max are in m."""
        d = np.asarray(distances, np.float32)
        hit = np.exp(np.float32(-0.5 / sigma**2) * d * d)
        hit *= np.float32(self.z_hit / (np.sqrt(2 * np.pi) * sigma))
        hit += np.float32(self.z_rand / range_max)
        return np.asarray(hit)

    def log_product(self, distances: npt.NDArray[np.floating], sigma: float, range_max: float) -> Array:
        """Sum of ln p over the beams (N,) in nats, as in nav2's likelihood_field_prob."""
        return np.asarray(np.log(self.densities(distances, sigma, range_max)).sum(axis=-1, dtype=np.float64))

    def log_cubes(self, distances: npt.NDArray[np.floating], sigma: float, range_max: float) -> Array:
        """ln(1 + sum of p³) (N,), with a Gaussian of height 1, as in nav2's likelihood_field.

        This is not a log density, but the weight that AMCL uses.
        """
        height = np.sqrt(2 * np.pi) * sigma
        p = height * (self.densities(distances, sigma, range_max) - self.z_rand / range_max) + self.z_rand / range_max
        return np.asarray(np.log1p((p**3).sum(axis=-1, dtype=np.float64)))
