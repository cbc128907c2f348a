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
SLOWEST = 0.7  # sigma shrinks by no more than this a scan: one scan must not decide a search
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

    def weigh(self, poses: Array, observation: Observation, sigma: float) -> tuple[Array, float]:
        """(N,) log weights of scanner poses (N, 3) in map, and how well they explain the scan on average, in (0, 1]."""
        used, ranges, angles = self._beams(observation, self.settings.max_beams)
        kind = self.settings.laser_model_type
        if len(ranges) == 0:
            return np.zeros(len(poses)), 1.0
        if kind == "beam" and self._table is not None:
            expected = self._table.ranges(poses, observation.angles[used])
            log = self._beam.log_density(observation.ranges[used], expected, observation.range_max).sum(axis=1)
            return log, self._geometric(log, len(used), np.log(self.settings.z_hit / (np.sqrt(2 * np.pi) * sigma)))
        ends = self.field.ends(poses, ranges, angles)
        if kind == "likelihood_field":
            log = self.field.log_cubes(ends, sigma, observation.range_max)
            return log, float(np.mean(np.expm1(log)) / len(ranges))
        log = self.field.log_product(ends, sigma, observation.range_max)
        best = float(np.log(self.field.densities(np.zeros(1), sigma, observation.range_max)[0]))
        return log, self._geometric(log, len(ranges), best)

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

    @staticmethod
    def _geometric(log: Array, beams: int, best: float) -> float:
        """Mean likelihood per beam relative to ``best``, a beam's in nats; the sum runs over particles (N,) of logs."""
        mean = log.max() + np.log(np.mean(np.exp(log - log.max())))
        return float(np.exp(min(0.0, mean / beams - best)))
