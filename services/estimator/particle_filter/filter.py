"""The filter: predict, weigh, cluster, resample."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.particle_filter import motion, resampling
from services.estimator.particle_filter.clusters import hypotheses
from services.estimator.particle_filter.recovery import Recovery
from services.estimator.particle_filter.sensor import Sensor
from services.estimator.particle_filter.settings import Settings
from services.estimator.shared.generative_models import RayCaster
from services.estimator.shared.interface import Observation, Posterior, Predicted, State

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from services.estimator.shared.interface import Hypothesis

NOMINAL_DT = 1 / 15  # s, between scans where no stamps tell; the jitter's unit
LONGEST_DT = 1.0  # s, a random walk over a longer gap would be everywhere: that is recovery's business
INITIAL_COVARIANCE = np.diag([0.25, 0.25, (np.pi / 12) ** 2])  # nav2's initial_cov
COMMAND_NOISE = 0.5  # of the recent speed: the base lags behind its command
COMMAND_MEMORY = 0.5  # s, for which a past command may still be acted upon
TIGHT = 0.3  # m, position standard deviation of a cluster that is one place
SURE = 0.95  # of the weight
PLACES = 20_000  # sampled over free space in advance: to find them scan by scan takes longer than to filter
LOST = 0.65  # short- over long-term fit below which the pose is not believed
SEARCHES = 3  # that end in one place and no good fit, before the poor fit is taken for the world's doing
FOUND = 0.85  # the same, above which it is again


class ParticleFilter:
    """Monte Carlo localisation with KLD-adaptive particles and augmented recovery; deterministic by seed."""

    name = "particle-filter"

    def __init__(
        self,
        world: World,
        settings: Settings | None = None,
        mount: tuple[float, float, float] = (0, 0, 0),
        seed: int = 0,
        heading: float | None = None,
        sensor: Sensor | None = None,
    ) -> None:
        """Spread over free space of ``world``; ``mount`` (3,) is laser in base_link, m, m, rad.

        ``heading`` rad: known and frozen, as the paper's robot has it; none: estimated. ``sensor``: one of this world
        and these settings, for several filters; none: one of its own.
        Raises UserError where the world is too large for the settings' resolution.
        """
        self.world, self.settings = world, settings or Settings()
        self.mount, self.heading = np.array(mount, float), heading
        self.sensor = sensor or Sensor(world, self.settings)
        self._rng = np.random.default_rng(seed)
        self._places = np.zeros((0, 2))
        self.restart()

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Begin anew: Gaussian about ``pose`` (3,) with ``covariance`` (3, 3), nav2's by default, or uniform."""
        s = self.settings
        if pose is None:
            self._places = self.world.sample_free(max(s.max_particles, PLACES), self._rng)
            self.particles = self._anywhere(s.max_particles, self._places[: s.max_particles])
        else:
            count = min(s.max_particles, max(s.min_particles, 2000))
            spread = INITIAL_COVARIANCE if covariance is None else np.asarray(covariance, float)
            self.particles = self._rng.multivariate_normal(np.asarray(pose, float), spread, count, method="eigh")
        self._freeze_heading()
        self.weights = np.full(len(self.particles), 1 / len(self.particles))
        self._recovery = Recovery(s.recovery_alpha_slow, s.recovery_alpha_fast)
        self._health = Recovery(0.01, 0.5)
        self._state: State = "localising"
        self._was_found, self._searches = False, 0
        self._scans = 0
        # A pose that was given is kept: nothing is searched, and no particles are drawn elsewhere.
        self._recovers = s.recovery_alpha_fast > 0 and (pose is None or not s.keep_initial_pose)
        self._searching = pose is None and self.sensor.widest > s.sigma_hit
        self._sigma = self.sensor.widest if self._searching else s.sigma_hit
        self._last: Observation | None = None
        self._speed = np.zeros(2)  # m/s, rad/s recently commanded

    def update(self, observation: Observation) -> Posterior:
        """The posterior after one more scan."""
        self._predict(observation)
        self._anneal()
        s, sigma, beams = self.settings, self._sigma, self.settings.max_beams
        share = s.search_share if self._searching else 0.0
        if s.sigma_odometry and observation.odom is not None and sigma <= 1.01 * s.sigma_hit:
            sigma, beams, share = s.sigma_odometry, None, s.odometry_share  # the particles are few and close together
        log_weights = self.sensor.weigh(se2.compose(self.particles, self.mount), observation, sigma, beams)
        log_weights += np.log(np.maximum(self.weights, 1e-300))
        self.weights = resampling.tempered(log_weights, share)
        posterior = self._posterior(observation, hypotheses(self.particles, self.weights))
        self._scans += 1
        if self._scans % s.resample_interval == 0:
            self._resample()
        self._last = observation
        return posterior

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """See Estimator: exact rays in its map; sigma is that of a hit while it tracks."""
        ranges = RayCaster(self.world).expect(se2.compose(poses, self.mount), angles).ranges
        return Predicted(ranges, np.full(ranges.shape, self.settings.sigma_hit))

    def _anywhere(self, count: int, places: Array | None = None) -> Array:
        """(count, 3) poses uniform over free space, at ``places`` (count, 2) or at ones sampled in advance."""
        if places is None:
            places = self._places[self._rng.integers(len(self._places), size=count)]
        return np.column_stack([places, self._rng.uniform(-np.pi, np.pi, count)])

    def _predict(self, now: Observation) -> None:
        """Move the particles by odometry, else by the last command, else at random."""
        last, s = self._last, self.settings
        if last is None:
            return
        dt = NOMINAL_DT
        if now.stamp is not None and last.stamp is not None and now.stamp >= last.stamp:
            dt = min(now.stamp - last.stamp, LONGEST_DT)
        alphas = (s.alpha1, s.alpha2, s.alpha3, s.alpha4, s.alpha5)
        model = motion.omni if s.robot_model_type == "omni" else motion.differential
        walk = np.array([s.jitter_position, s.jitter_heading]) * dt / NOMINAL_DT
        # While searching a particle stands for its surroundings: it must be able to come nearer. How far its neighbours
        # are does not depend on the time between scans.
        search = self._searching * (self._sigma - s.sigma_hit) / max(self.sensor.widest - s.sigma_hit, 1e-9)
        position, heading = np.maximum(
            (s.floor_position, s.floor_heading), (search * s.jitter_position, search * s.jitter_heading)
        )
        moved = self.particles
        if now.odom is not None and last.odom is not None:
            moved = model(moved, se2.between(last.odom, now.odom), alphas, self._rng)
        elif now.command is not None:
            speed = np.array([np.hypot(now.command[0], now.command[1]), abs(now.command[2])])
            self._speed = np.maximum(speed, self._speed * np.exp(-dt / COMMAND_MEMORY))
            moved = se2.compose(moved, motion.arc(now.command, dt))
            position, heading = np.hypot((position, heading), COMMAND_NOISE * dt * self._speed)
        else:
            walks = self._rng.random(len(moved)) < s.walk_share
            position, heading = (
                np.where(walks, far, near) for far, near in zip(walk, (position, heading), strict=True)
            )
        self.particles = motion.jitter(moved, position, heading, self._rng)
        self.particles[:, 2] = se2.wrap(self.particles[:, 2])
        self._freeze_heading()

    def _freeze_heading(self) -> None:
        if self.heading is not None:
            self.particles[:, 2] = self.heading

    def _anneal(self) -> None:
        """Sigma of a hit follows the spread of the particles; a search that found nothing begins again."""
        if self._recovers and self._state == "lost" and not self._searching and self._health.ratio < LOST:
            self._searching, self._sigma = True, self.sensor.widest
            self._searches += 1
            return
        off = self.particles[:, :2] - np.median(self.particles[:, :2], axis=0)
        spread = float(np.median(np.hypot(off[:, 0], off[:, 1])))
        self._sigma = self.sensor.sigma(spread, self._sigma)
        self._searching &= self._sigma > self.settings.sigma_hit

    def _judge(self, found: tuple[Hypothesis, ...]) -> State:
        tight = [h.covariance is not None and np.sqrt(np.trace(h.covariance[:2, :2])) < TIGHT for h in found]
        sharp = not self._searching or self._sigma < 1.5 * self.settings.sigma_hit
        settled = found[0].weight > SURE and tight[0] and sharp
        if self._was_found and self._health.ratio < (FOUND if self._state == "lost" else LOST):
            if self._searches <= SEARCHES or not settled or not self._recovers:
                return "lost"
            self._health.accept()
            self._recovery.accept()
        self._searches = 0
        if settled:
            if self._state != "tracking":
                self._was_found = True
                self._health.converged()
                self._recovery.converged()
            return "tracking"
        if found[0].weight <= SURE and sum(h.weight for h, t in zip(found, tight, strict=True) if t) > SURE:
            return "ambiguous"
        return "localising"

    def _posterior(self, observation: Observation, found: tuple[Hypothesis, ...]) -> Posterior:
        pose = found[0].pose
        explanation = self.sensor.explain(pose, self.mount, observation)
        self._recovery.add(explanation.fit)
        self._health.add(explanation.fit)
        self._state = self._judge(found)
        return Posterior(
            state=self._state,
            hypotheses=found,
            accuracy=explanation.accuracy,
            complexity=0.0,  # particles have no density to compare with the prior's
            xi=explanation.xi,
            curvature=explanation.curvature,
            predicted=self.world.ray_distances(se2.compose(pose, self.mount), observation.angles)[0],
        )

    def _resample(self) -> None:
        """As many particles as the belief needs, a share of them anywhere when scans have stopped to fit."""
        s, rng = self.settings, self._rng
        share = self._recovery.random_share if self._recovers else 0.0
        at = resampling.bins(self.particles)
        trial = self._most_needed(len(np.unique(at)), share)
        drawn = at[rng.permutation(resampling.low_variance(self.weights, trial, rng))]
        strangers = self._anywhere(int(rng.binomial(trial, share))) if share > 0 else np.zeros((0, 3))
        if len(strangers):
            drawn[rng.permutation(trial)[: len(strangers)]] = resampling.bins(strangers)
        count = resampling.adaptive_count(drawn, s.pf_err, s.pf_z, s.min_particles, s.max_particles)
        strangers = strangers[: int(rng.binomial(count, share))]
        chosen = resampling.low_variance(self.weights, count - len(strangers), rng)
        self.particles = np.concatenate([self.particles[chosen], strangers])
        self.weights = np.full(count, 1 / count)
        self._freeze_heading()

    def _most_needed(self, occupied: int, share: float) -> int:
        """Particles that suffice in any case: no draw meets more bins than are occupied, and one a stranger."""
        s, count = self.settings, self.settings.min_particles
        while count < s.max_particles:
            needed = resampling.kld_bound(occupied + np.ceil(1.5 * share * count), s.pf_err, s.pf_z)
            if needed <= count:
                break
            count = int(needed)
        return min(count, s.max_particles)
