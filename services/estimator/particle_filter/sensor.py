"""One scan against many poses: the settings' laser model, its beams, its annealed sigma, and its gradient."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common import se2
from services.estimator.particle_filter.beam_model import BeamModel, RangeTable
from services.estimator.particle_filter.likelihood_field import DistanceField, LikelihoodField

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.se2 import Array
    from common.world import World
    from services.estimator.interface import Observation
    from services.estimator.particle_filter.settings import Settings

SIGMA_PER_SPREAD = 1.5  # a hit is as blurred as the particles are sparse
SLOWEST = 0.85  # sigma shrinks by no more than this a scan: one scan must not decide a search
# Beams' worth of likelihood in a fit. All of them and it jumps at every scan; 1 and a place that only looks alike fits.
SHARPNESS = 2.0
STEP = np.array([0.01, 0.01, 0.002])  # m, m, rad of the numeric gradient


class Sensor:
    """How likely scans are at poses, under the settings' laser model."""

    def __init__(self, world: World, settings: Settings) -> None:
        """Build the distance field of ``world``, and the table of ranges where the beam model wants it."""
        s = self.settings = settings
        self.field = LikelihoodField(DistanceField(world, s.resolution, s.laser_likelihood_max_dist), s.z_hit, s.z_rand)
        self.widest = max(s.sigma_hit, s.sigma_search)
        self._table = RangeTable(world, s.resolution) if s.laser_model_type == "beam" else None
        self._beam = BeamModel(s.z_hit, s.z_short, s.z_max, s.z_rand, s.sigma_hit, s.lambda_short)

    def sigma(self, spread: float, before: float) -> float:
        """Standard deviation of a hit in m for particles ``spread`` m about their median, after one of ``before`` m."""
        wanted = float(np.clip(SIGMA_PER_SPREAD * spread, self.settings.sigma_hit, self.widest))
        return max(wanted, SLOWEST * before) if before > self.settings.sigma_hit else wanted

    def weigh(self, poses: Array, observation: Observation, sigma: float) -> Array:
        """(N,) log weights of scanner poses (N, 3) in map; ``sigma`` m of a hit, but the beam model keeps its own."""
        used, ranges, angles = self._beams(observation, self.settings.max_beams)
        kind = self.settings.laser_model_type
        if kind == "beam" and self._table is not None:
            expected = self._table.ranges(poses, observation.angles[used])
            log = self._beam.log_density(observation.ranges[used], expected, observation.range_max)
            return np.asarray(log.sum(axis=1))
        ends = self.field.ends(poses, ranges, angles)
        if kind == "likelihood_field":
            return self.field.log_cubes(ends, sigma, observation.range_max)
        return self.field.log_product(ends, sigma, observation.range_max)

    def explain(self, pose: Array, mount: Array, observation: Observation) -> tuple[float, Array, Array]:
        """At base_link ``pose`` (3,): -ln p(o | pose) in nats over all beams, xi (3,) and curvature (3, 3) of it.

        The product likelihood field with the tracking sigma; derivatives of the distances by central differences.
        """
        _, ranges, angles = self._beams(observation, None)
        sigma = self.settings.sigma_hit
        offsets = np.diag(STEP)
        poses = se2.compose(np.concatenate([pose[None], pose + offsets, pose - offsets]), mount)
        ends = self.field.ends(poses, ranges, angles).astype(float)
        d, slope = ends[0], (ends[1:4] - ends[4:]) / (2 * STEP[:, None])
        p = self.field.densities(d, sigma, observation.range_max).astype(float)
        # Beams that the surface explains pull; the others are z_rand's.
        pull = (1 - self.field.z_rand / observation.range_max / p) / sigma**2
        return float(-np.log(p).sum()), -slope @ (pull * d), (slope * pull) @ slope.T

    def _beams(self, observation: Observation, most: int | None) -> tuple[npt.NDArray[np.int_], Array, Array]:
        """Indices of at most ``most`` beams, evenly spaced, and ranges and angles of those that ended somewhere."""
        count = len(observation.ranges)
        used = np.arange(count)
        if most is not None and most < count:
            used = np.round(np.linspace(0, count - 1, most)).astype(int)
        ranges = observation.ranges[used]
        ended = np.isfinite(ranges) & (ranges < observation.range_max)
        return used, ranges[ended], observation.angles[used][ended]

    def fit(self, accuracy: float, observation: Observation) -> float:
        """How well ``accuracy`` nats explain the scan, in (0, 1]: its mean per beam against an exact beam's."""
        beams = len(self._beams(observation, None)[1])
        exact = np.log(self.field.densities(np.zeros(1), self.settings.sigma_hit, observation.range_max)[0])
        return float(np.exp(SHARPNESS * min(0.0, -accuracy / max(beams, 1) - exact)))
