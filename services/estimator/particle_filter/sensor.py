"""Weighs particles with the chosen laser model."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from common.geometry import se2
from services.estimator.particle_filter.beam_model import BeamModel, RangeTable
from services.estimator.particle_filter.likelihood_field import LikelihoodField, SurfaceDistances

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from common.geometry.world import World
    from services.estimator.particle_filter.settings import ParticleFilterSettings
    from services.estimator.shared.interface import Observation

SIGMA_PER_SPREAD = 1.5  # sigma of a hit, relative to the spread of the particles
MIN_SIGMA_FACTOR = 0.85  # limits how fast sigma shrinks per scan, so that one scan cannot decide a search
GRADIENT_STEP = np.array([0.01, 0.01, 0.002])  # m, m, rad


class ScanFit(NamedTuple):
    """How well a pose explains a scan."""

    accuracy: float  # nats, -ln p(o | pose)
    xi: Array  # (3,) minus the gradient of accuracy by the pose in map: 1/m, 1/m, 1/rad
    curvature: Array  # (3, 3) Gauss-Newton Hessian, in map
    # Mean likelihood of a beam, relative to that of an exact one: about the fraction of beams explained. NaN if no beam
    # returned.
    fit: float


class Sensor:
    """The laser model that the settings select, in one world."""

    def __init__(self, world: World, settings: ParticleFilterSettings) -> None:
        """Builds the distance field of ``world``, and the table of ranges if the settings select the beam model."""
        s = self.settings = settings
        self.field = LikelihoodField(
            SurfaceDistances(world, s.resolution, s.laser_likelihood_max_dist), s.z_hit, s.z_rand
        )
        self.max_sigma = max(s.sigma_hit, s.sigma_search)
        self._table = RangeTable(world, s.resolution) if s.laser_model_type == "beam" else None
        self._beam = BeamModel(s.z_hit, s.z_short, s.z_max, s.z_rand, s.sigma_hit, s.lambda_short)

    def sigma(self, spread: float, previous: float) -> float:
        """Standard deviation of a hit in m for particles spread by ``spread`` m; ``previous`` is the last scan's."""
        target = float(np.clip(SIGMA_PER_SPREAD * spread, self.settings.sigma_hit, self.max_sigma))
        return max(target, MIN_SIGMA_FACTOR * previous) if previous > self.settings.sigma_hit else target

    def weigh(self, poses: Array, observation: Observation, sigma: float, beams: int | None) -> Array:
        """Returns log weights (N,) of scanner poses (N, 3) in map, from at most ``beams`` beams, or all if None.

        ``sigma`` is the standard deviation of a hit in m; the beam model uses its own instead.
        """
        used, ranges, angles = self._beams(observation, beams)
        kind = self.settings.laser_model_type
        if kind == "beam" and self._table is not None:
            expected = self._table.ranges(poses, observation.angles[used])
            log = self._beam.log_density(observation.ranges[used], expected, observation.range_max)
            return np.asarray(log.sum(axis=1))
        ends = self.field.ends(poses, ranges, angles)
        if kind == "likelihood_field":
            return self.field.log_cubes(ends, sigma, observation.range_max)
        return self.field.log_product(ends, sigma, observation.range_max)

    def explain(self, pose: Array, mount: Array, observation: Observation, sigma: float | None = None) -> ScanFit:
        """Evaluates all beams of a scan at base_link ``pose`` (3,) in map, by the product likelihood field.

        ``sigma`` m of a hit defaults to that of tracking. Derivatives of the distances are central differences.
        """
        _, ranges, angles = self._beams(observation, None)
        sigma = self.settings.sigma_hit if sigma is None else sigma
        offsets = np.diag(GRADIENT_STEP)
        poses = se2.compose(np.concatenate([pose[None], pose + offsets, pose - offsets]), mount)
        ends = self.field.ends(poses, ranges, angles).astype(float)
        d, slope = ends[0], (ends[1:4] - ends[4:]) / (2 * GRADIENT_STEP[:, None])
        p = self.field.densities(np.append(d, 0.0), sigma, observation.range_max).astype(float)
        p, exact = p[:-1], p[-1]
        # Only beams that a surface explains contribute to the gradient.
        pull = (1 - self.field.z_rand / observation.range_max / p) / sigma**2
        return ScanFit(
            accuracy=float(-np.log(p).sum()),
            xi=-slope @ (pull * d),
            curvature=(slope * pull) @ slope.T,
            fit=float(p.mean() / exact) if len(p) else np.nan,
        )

    def _beams(self, observation: Observation, max_beams: int | None) -> tuple[npt.NDArray[np.int_], Array, Array]:
        """Indices of at most ``max_beams`` beams, evenly spaced, and ranges and angles of those that returned."""
        count = len(observation.ranges)
        used = np.arange(count)
        if max_beams is not None and max_beams < count:
            used = np.round(np.linspace(0, count - 1, max_beams)).astype(int)
        ranges = observation.ranges[used]
        returned = np.isfinite(ranges) & (ranges < observation.range_max)
        return used, ranges[returned], observation.angles[used][returned]
