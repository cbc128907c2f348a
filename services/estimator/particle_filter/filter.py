"""The filter: predict, weigh, cluster, resample."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.particle_filter import motion, resampling
from services.estimator.particle_filter.clusters import cluster_hypotheses
from services.estimator.particle_filter.fit_averages import FitAverages
from services.estimator.particle_filter.sensor import Sensor
from services.estimator.particle_filter.settings import ParticleFilterSettings
from services.estimator.shared.interface import Observation, Posterior, Predicted, State, start_belief
from services.estimator.shared.motion_correction import correct_motion, pose_at_stamp

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World
    from services.estimator.shared.interface import Hypothesis

NOMINAL_PERIOD_S = 1 / 15  # between scans without stamps; the settings state the random walk per such period
MAX_PERIOD_S = 1.0  # for the motion model; after longer gaps recovery must find the robot
INITIAL_COVARIANCE = np.diag([0.25, 0.25, (np.pi / 12) ** 2])  # nav2's initial_cov
COMMAND_NOISE = 0.5  # as a share of the recently commanded speed, because the base lags behind its command
VELOCITY_SHARE = 0.5  # of the motion since the last scan in the average velocity; the rest is that of earlier scans
COMMAND_MEMORY_S = 0.5  # for which a past command may still have effect
MAX_CLUSTER_DEVIATION_M = 0.3  # position standard deviation of a cluster that counts as one place
TRACKING_WEIGHT = 0.95  # minimum weight of the best cluster in state tracking
SAMPLED_PLACES = 20_000  # in free space, sampled in advance because sampling takes longer than an update
LOST_FIT_RATIO = 0.65  # ratio of short- to long-term fit below which the pose is not believed
FOUND_FIT_RATIO = 0.85  # ratio above which it is believed again
MAX_SEARCHES = 3  # after so many searches that end at one place with a poor fit, the world must have changed


class ParticleFilter:
    """Monte Carlo localisation with KLD-adaptive sampling and augmented recovery; deterministic for a given seed."""

    name = "particle-filter"

    def __init__(
        self,
        world: World,
        settings: ParticleFilterSettings | None = None,
        mount: tuple[float, float, float] = (0, 0, 0),
        seed: int = 0,
        heading: float | None = None,
        sensor: Sensor | None = None,
    ) -> None:
        """Starts from an unknown pose in ``world``; ``mount`` (3,) is the laser in base_link, m, m, rad.

        ``heading`` rad is a known and constant heading, as in the paper; by default the heading is estimated.
        ``sensor`` may be shared by several filters with the same world and settings; by default a new one is built.
        Raises UserError if the world is too large for the settings' resolution.
        """
        self.world, self.settings = world, settings or ParticleFilterSettings()
        self.mount, self.heading = np.array(mount, float), heading
        self.sensor = sensor or Sensor(world, self.settings)
        self._rng = np.random.default_rng(seed)
        self._places = np.zeros((0, 2))
        self.restart()

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Starts from a Gaussian at ``pose`` (3,) with ``covariance`` (3, 3), or from an unknown pose.

        A ``pose`` (2,) is a position with an unknown heading. The default covariance is nav2's.
        """
        s = self.settings
        if pose is None:
            self._places = self.world.sample_free(max(s.max_particles, SAMPLED_PLACES), self._rng)
            self.particles = self._anywhere(s.max_particles, self._places[: s.max_particles])
        else:
            count = min(s.max_particles, max(s.min_particles, 2000))
            mean, spread = start_belief(pose, INITIAL_COVARIANCE if covariance is None else covariance)
            self.particles = self._rng.multivariate_normal(mean, spread, count, method="eigh")
        self._freeze_heading()
        self.weights = np.full(len(self.particles), 1 / len(self.particles))
        self._fit_for_recovery = FitAverages(s.recovery_alpha_slow, s.recovery_alpha_fast)
        self._fit_for_state = FitAverages(0.01, 0.5)  # averages over about 100 and 2 scans
        self._state: State = "localising"
        self._was_found, self._searches = False, 0
        self._scans = 0
        # A pose that was given is kept: there is no search, and no particles are drawn elsewhere.
        self._recovers = s.recovery_alpha_fast > 0 and (pose is None or not s.keep_initial_pose)
        self._searching = pose is None and self.sensor.max_sigma > s.sigma_hit
        self._sigma = self.sensor.max_sigma if self._searching else s.sigma_hit
        self._last: Observation | None = None
        self._tracked: Array | None = None  # (3,) pose in the middle of the last sweep, if in state tracking
        self._velocity: Array | None = None  # (3,) in base_link, between the last poses; None if unknown
        self._speed = np.zeros(2)  # m/s and rad/s, recently commanded

    def update(self, observation: Observation) -> Posterior:
        """Returns the posterior after one more scan."""
        last_stamp, last_odom = (None, None) if self._last is None else (self._last.stamp, self._last.odom)
        period, odom = observation.period_since(last_stamp, NOMINAL_PERIOD_S), observation.odometry_since(last_odom)
        self._predict(observation, min(period, MAX_PERIOD_S), odom)
        self._anneal()
        if observation.is_earlier_than(last_stamp):
            self._velocity = self._tracked = None
        elif self._velocity is None and odom is not None:
            self._velocity = odom / period
        corrected = correct_motion(observation, self._velocity, self.mount)
        s, sigma, beams = self.settings, self._sigma, self.settings.max_beams
        share = s.search_share if self._searching else 0.0
        if s.sigma_odometry and observation.odom is not None and sigma <= 1.01 * s.sigma_hit:
            # All beams can be used, because the particles are few and close together.
            sigma, beams, share = s.sigma_odometry, None, s.odometry_share
        log_weights = self.sensor.weigh(se2.compose(self.particles, self.mount), corrected, sigma, beams)
        log_weights += np.log(np.maximum(self.weights, 1e-300))
        self.weights = resampling.tempered(log_weights, share)
        posterior = self._posterior(corrected, cluster_hypotheses(self.particles, self.weights))
        self._update_velocity(posterior, period)
        posterior = self._at_stamp(posterior, observation, period)
        self._scans += 1
        if self._scans % s.resample_interval == 0:
            self._resample()
        self._last = observation
        return posterior

    def _update_velocity(self, posterior: Posterior, period: float) -> None:
        """Averages the velocity over the last poses, while they are tracked."""
        before, self._tracked = self._tracked, posterior.pose if posterior.state == "tracking" else None
        if before is None or self._tracked is None:
            self._velocity = None
            return
        velocity = se2.between(before, self._tracked) / period
        old = velocity if self._velocity is None else self._velocity
        self._velocity = old + VELOCITY_SHARE * (velocity - old)

    def _at_stamp(self, posterior: Posterior, observation: Observation, period: float) -> Posterior:
        """The posterior at the stamp, from that in the middle of the sweep."""
        found = tuple(
            replace(each, pose=pose_at_stamp(each.pose, self._velocity, period, observation))
            for each in posterior.hypotheses
        )
        laser = se2.compose(found[0].pose, self.mount)
        return replace(posterior, hypotheses=found, predicted=self.world.ray_distances(laser, observation.angles)[0])

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """Predicts scans (see PoseEstimator) by exact rays in the map; sigma is that of a hit while tracking."""
        ranges = self.world.ray_distances(se2.compose(poses, self.mount), angles)
        return Predicted(ranges, np.full(ranges.shape, self.settings.sigma_hit))

    def _anywhere(self, count: int, places: Array | None = None) -> Array:
        """Poses (count, 3), uniform over free space: at ``places`` (count, 2), or at places sampled in advance."""
        if places is None:
            places = self._places[self._rng.integers(len(self._places), size=count)]
        return np.column_stack([places, self._rng.uniform(-np.pi, np.pi, count)])

    def _predict(self, now: Observation, period: float, odom: Array | None) -> None:
        """Moves the particles by the odometry ``odom`` (3,) if there is any, else by the command, else at random."""
        s = self.settings
        if self._last is None:
            return
        alphas = (s.alpha1, s.alpha2, s.alpha3, s.alpha4, s.alpha5)
        model = motion.omni if s.robot_model_type == "omni" else motion.differential
        walk = np.array([s.jitter_position, s.jitter_heading]) * period / NOMINAL_PERIOD_S
        # During a search a particle represents its surroundings, so it must be able to move within them. The distance
        # to its neighbours does not depend on the time between scans.
        search = self._searching * (self._sigma - s.sigma_hit) / max(self.sensor.max_sigma - s.sigma_hit, 1e-9)
        position, heading = np.maximum(
            (s.floor_position, s.floor_heading), (search * s.jitter_position, search * s.jitter_heading)
        )
        moved = self.particles
        if odom is not None:
            moved = model(moved, odom, alphas, self._rng)
        elif now.command is not None:
            speed = np.array([np.hypot(now.command[0], now.command[1]), abs(now.command[2])])
            self._speed = np.maximum(speed, self._speed * np.exp(-period / COMMAND_MEMORY_S))
            moved = se2.compose(moved, motion.arc(now.command, period))
            position, heading = np.hypot((position, heading), COMMAND_NOISE * period * self._speed)
        else:
            walks = self._rng.random(len(moved)) < s.walk_share
            position, heading = (
                np.where(walks, wide, narrow) for wide, narrow in zip(walk, (position, heading), strict=True)
            )
        self.particles = motion.jitter(moved, position, heading, self._rng)
        self.particles[:, 2] = se2.wrap(self.particles[:, 2])
        self._freeze_heading()

    def _freeze_heading(self) -> None:
        if self.heading is not None:
            self.particles[:, 2] = self.heading

    def _anneal(self) -> None:
        """Adapts sigma of a hit to the spread of the particles; starts a new search if the filter is lost."""
        if (
            self._recovers
            and self._state == "lost"
            and not self._searching
            and self._fit_for_state.ratio < LOST_FIT_RATIO
        ):
            self._searching, self._sigma = True, self.sensor.max_sigma
            self._searches += 1
            return
        off = self.particles[:, :2] - np.median(self.particles[:, :2], axis=0)
        spread = float(np.median(np.hypot(off[:, 0], off[:, 1])))
        self._sigma = self.sensor.sigma(spread, self._sigma)
        self._searching &= self._sigma > self.settings.sigma_hit

    def _next_state(self, found: tuple[Hypothesis, ...]) -> State:
        """The state after a scan, from the hypotheses and how well the best one has fitted the last scans."""
        tight = [
            h.covariance is not None and np.sqrt(np.trace(h.covariance[:2, :2])) < MAX_CLUSTER_DEVIATION_M
            for h in found
        ]
        sharp = not self._searching or self._sigma < 1.5 * self.settings.sigma_hit
        settled = found[0].weight > TRACKING_WEIGHT and tight[0] and sharp
        if self._was_found and self._fit_for_state.ratio < (
            FOUND_FIT_RATIO if self._state == "lost" else LOST_FIT_RATIO
        ):
            if self._searches <= MAX_SEARCHES or not settled or not self._recovers:
                return "lost"
            self._fit_for_state.accept()
            self._fit_for_recovery.accept()
        self._searches = 0
        if settled:
            if self._state != "tracking":
                self._was_found = True
                self._fit_for_state.converged()
                self._fit_for_recovery.converged()
            return "tracking"
        if (
            found[0].weight <= TRACKING_WEIGHT
            and sum(h.weight for h, t in zip(found, tight, strict=True) if t) > TRACKING_WEIGHT
        ):
            return "ambiguous"
        return "localising"

    def _posterior(self, observation: Observation, found: tuple[Hypothesis, ...]) -> Posterior:
        pose = found[0].pose
        scan_fit = self.sensor.explain(pose, self.mount, observation)
        if not np.isnan(scan_fit.fit):
            self._fit_for_recovery.add(scan_fit.fit)
            self._fit_for_state.add(scan_fit.fit)
        self._state = self._next_state(found)
        return Posterior(
            state=self._state,
            hypotheses=found,
            accuracy=scan_fit.accuracy,
            complexity=0.0,  # not defined, because particles have no density to compare with that of the prior
            xi=scan_fit.xi,
            curvature=scan_fit.curvature,
            predicted=np.zeros(0),  # of the pose at the stamp, set by _at_stamp
        )

    def _resample(self) -> None:
        """Draws as many particles as the belief needs; a share at random places if scans no longer fit."""
        s, rng = self.settings, self._rng
        share = self._fit_for_recovery.random_share if self._recovers else 0.0
        bins = resampling.bins(self.particles)
        trial = self._upper_bound(len(np.unique(bins)), share)
        drawn = bins[rng.permutation(resampling.low_variance(self.weights, trial, rng))]
        random_poses = self._anywhere(int(rng.binomial(trial, share))) if share > 0 else np.zeros((0, 3))
        if len(random_poses):
            drawn[rng.permutation(trial)[: len(random_poses)]] = resampling.bins(random_poses)
        count = resampling.adaptive_count(drawn, s.pf_err, s.pf_z, s.min_particles, s.max_particles)
        random_poses = random_poses[: int(rng.binomial(count, share))]
        chosen = resampling.low_variance(self.weights, count - len(random_poses), rng)
        self.particles = np.concatenate([self.particles[chosen], random_poses])
        self.weights = np.full(count, 1 / count)
        self._freeze_heading()

    def _upper_bound(self, occupied: int, share: float) -> int:
        """Number of particles that always suffices: draws occupy at most the present bins and one per random pose."""
        s, count = self.settings, self.settings.min_particles
        while count < s.max_particles:
            needed = resampling.kld_bound(occupied + np.ceil(1.5 * share * count), s.pf_err, s.pf_z)
            if needed <= count:
                break
            count = int(needed)
        return min(count, s.max_particles)
