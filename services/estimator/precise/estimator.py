"""The precise estimator. `PreciseEstimator.track` and `search` take the steps of docs/precise.md, section Update."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.robot.motion_distortion import sweep_time
from services.estimator.precise.gauss_newton import COARSE_SIGMA_M, GaussNewton, Optimiser, Prior
from services.estimator.precise.hypotheses import (
    OFF_MAP_PROBABILITY,
    SURROUNDINGS_PRIOR,
    SURROUNDINGS_TRANSITIONS,
    UNKNOWN_PROBABILITY,
    TrackedHypothesis,
    UnknownPlace,
    clip_to_map,
    probability_of_being_near,
    project_evidence,
    unobserved_directions,
    update_hypothesis,
    weigh,
)
from services.estimator.precise.likelihood import Evidence, Likelihood
from services.estimator.precise.local_map import (
    ChangeRate,
    LocalMap,
    LocalMapScan,
    LocalScan,
    MovedFraction,
    count_changes,
)
from services.estimator.precise.motion_model import (
    MotionCandidate,
    decouple,
    expected_motion,
    fuse,
    limit_covariance,
    motion_complexity,
    motion_cost,
    predict_motion,
    reachable_poses,
    widen_unobserved,
)
from services.estimator.precise.precision import Precision
from services.estimator.precise.protection import EstimateError
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.estimator.precise.search import search_around, search_everywhere, search_near
from services.estimator.precise.settings import PreciseSettings
from services.estimator.precise.swept_scan import SweptEvidence, acceleration_factors, acceleration_limits
from services.estimator.shared.interface import (
    Hypothesis,
    Observation,
    Posterior,
    Predicted,
    State,
    start_belief,
)
from services.estimator.shared.motion_correction import correct_motion, pose_at_stamp, times_from_middle

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from services.estimator.precise.global_seeds import Seeds
    from services.estimator.shared.generative_models import Expected, GenerativeModel

START_COVARIANCE = np.diag([0.25, 0.25, 0.09])  # m², m², rad², of a start that is given without one
MAX_SEARCH_INTERVAL_SCANS = 150  # between two searches without success; the interval doubles from 1
# Probability (a guess) that a match with the local map is wrong. The match is rejected if the scan is less probable
# than this at its pose in the map, relative to the pose that fits the map best.
LOCAL_MISMATCH_PROBABILITY = 1e-6
# A scan that the map predicts worse than the last one by more than this may be matched at a wrong pose (a guess). Then
# a wider area is searched.
MAX_FIT_DROP_NATS = 20.0
# The probability that the map's errors are this large, before a key scan has shown them: guesses.
ROUGH_MAP_PROBABILITY, ROUGH_MAP_ERROR_M = 1e-4, 0.03
# Smaller errors of the map, divided by the scanner's noise, cannot be told from the noise of one scan (a guess).
SIGNIFICANT_MAP_ERROR = 0.25
# A beam at a surface that the map lacks ends at one of the map's by chance with at most this probability. At nine of
# ten wrong poses, the map explained less than 5 % of the scan (9 % in the worst of the buildings of development).
EXPLAINED_BY_CHANCE = 0.1
TRACKING_PROBABILITY = 0.999  # in state `tracking`: of the pose being within 0.2 m and 5 degrees of the truth
# The state is `ambiguous` if the second hypothesis has more than this weight (a guess), or if the best one would be
# `tracking` without the others.
AMBIGUOUS_WEIGHT = 0.05
ALL_CHANGED_PROBABILITY = 0.01  # that nothing around a given start is as the map shows it (a guess)
UNKNOWN_SIGMA_M = 100.0  # published where the map is unknown
# A motion, or a number of changes, that is less probable (a guess) may be due to a kidnapping. Such a motion causes a
# search; such a number of changes does, too, if another place could fit much better.
SUDDEN_CHANGE_PROBABILITY = 0.01
MIN_GAIN_NATS = 1.0  # by which a scan must be more probable at a place of the map than at an unknown one (a guess)
TARGET_BEAMS = 2000  # a scan with at least twice as many is thinned, because the time of a search grows with the beams


@dataclass(frozen=True)
class ScanMatch:
    """The poses at which a scan fits the map, near the predicted pose of each hypothesis."""

    scan: ScanLikelihood
    # For each hypothesis the ways it may have moved, the widest at the end; a single one if the local map shows it.
    motions: list[list[MotionCandidate]]
    poses: Array  # (N, 3), one per hypothesis
    evidence: Evidence  # at these poses
    local_pose: Array | None = None  # (3,) in the local frame, if the motion comes from the local map
    swept: SweptEvidence | None = None  # if the scan took time, and was corrected for the motion

    @cached_property
    def explained(self) -> Array:
        """Fraction (N,) of the beams that end at surfaces of the map."""
        return self.scan.surface_evidence(self.poses).explained

    @cached_property
    def unobserved(self) -> list[Array]:
        """The directions that the scan does not observe, see `unobserved_directions`."""
        return unobserved_directions(self.scan, self.poses, self.evidence.curvature)


class PreciseEstimator:
    """Estimator whose error is near the limit set by the scanner's noise (docs/precise.md)."""

    name = "precise"

    def __init__(
        self,
        model: GenerativeModel,
        seeds: Seeds,
        mount: Array,
        likelihood: Likelihood | None = None,
        settings: PreciseSettings | None = None,
        rng: np.random.Generator | None = None,
        bounds: tuple[float, float, float, float] | None = None,
        optimiser: Optimiser | None = None,
        map_cell: float = 0.0,
    ) -> None:
        """``mount`` (3,) is the laser in base_link; ``rng`` draws the starts of a search near a given pose.

        The belief stays within ``bounds``, the map's x0, y0, x1, y1 in m. ``map_cell`` is the edge in m of the cells of
        a grid whose surfaces the model predicts at the front of the cells; 0 if it has learned where they are.
        """
        self.model, self.seeds, self.mount = model, seeds, np.array(mount, float)
        self.likelihood, self.settings = likelihood or Likelihood(), settings or PreciseSettings()
        self.bounds = bounds or (-np.inf, -np.inf, np.inf, np.inf)
        self._rng = rng or np.random.default_rng(0)
        self._optimiser, self._map_cell = optimiser or GaussNewton(), map_cell
        self.restart()

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Starts from ``pose`` with ``covariance`` (3, 3), or from an unknown pose.

        The default covariance is that of standard deviations of 0.5 m, 0.5 m and 0.3 rad. A ``pose`` (2,) is a position
        with an unknown heading.
        """
        self.hypotheses: list[TrackedHypothesis] = []  # best first
        self._start: tuple[Array, Array] | None = None  # pose and covariance, until the first search
        if pose is not None:
            self._start = start_belief(pose, START_COVARIANCE if covariance is None else covariance)
        self._has_tracked = False
        self._unknown_place = UnknownPlace()
        self._local_map = LocalMap()
        self._change_rate, self._moved_fraction = ChangeRate(), MovedFraction()
        self._precision = Precision.before_first_scan(self._map_cell)
        self._scans_since_search, self._search_interval = 0, 1

        # The last scan
        self._stamp: float | None = None
        self._odom: Array | None = None
        self._last_log_fit = 0.0  # nats, see `_log_fit`; at the best hypothesis
        self._last: LocalScan | None = None

        # The present scan
        self._scan: tuple[ScanLikelihood, Observation] | None = None
        self._local_pose = np.zeros(3)  # in the frame of the local map
        self._ignored_beams = np.zeros(0, np.bool_)  # (B,) no evidence, see `LocalMapScan.ignored`
        self._log_change = 0.0  # nats, log probability of the changes since the last scan
        self._changes = 0  # surfaces that have vanished or appeared since then
        # Surfaces that the map lacks: those that have appeared since the last key scans, and those seen there
        self._moved = self._stayed = 0
        # nats, evidence that the robot was kidnapped between the last scan and this one, without that of this scan
        self._log_kidnapped = -np.inf

    def use_model(self, model: GenerativeModel, seeds: Seeds) -> None:
        """Replaces the model by one learned from real scans in the same frame; the belief stays."""
        self.model, self.seeds, self._map_cell = model, seeds, 0.0
        self._precision.forget_map()

    def update(self, observation: Observation) -> Posterior:
        """Returns the posterior after one more scan."""
        posterior = self.track(observation)
        return self.search() if posterior is None else posterior

    def track(self, observation: Observation) -> Posterior | None:
        """Returns the posterior after one more scan, or None if `search` must be called for it."""
        scan = self._scan_likelihood(observation)
        if not self.hypotheses:
            self._scan = scan, observation
            return None
        # Motion prior
        period, odom = self._period(observation), observation.odometry_since(self._odom)
        motions = [self._predict_motion(each, period, odom, observation.command) for each in self.hypotheses]
        # Optimisation
        match = self._match_map(scan, motions, period, with_odometry=odom is not None)
        # Local map
        if match.explained[0] < self.settings.min_explained_fraction or len(match.unobserved[0]):
            predicted = expected_motion(motions[0]) if odom is not None else motions[0][-1]
            match = self._match_local_map(
                match, self._predict_local_motion(period, odom, observation.command), predicted.covariance
            )
        if (
            0 < sweep_time(len(observation.angles), observation.time_increment) / 2 < period
            and not observation.is_earlier_than(self._stamp)
            and motions[0][-1].is_near(match.poses[0])
        ):
            # Only if the robot can have moved like this: otherwise it may have been carried to another place, and may
            # have stood still during the scan.
            match = self._correct_motion_again(match, observation, period)
        # Fusion of match and motion prior
        scan = match.scan
        fused = [self._fuse(k, match, motions[k], observation) for k in range(len(match.poses))]
        hypotheses = [hypothesis for hypothesis, _ in fused]
        hypotheses += self._find_alternatives(scan, *fused[0], motions[0])
        is_motion_sudden = -hypotheses[0].motion_cost < np.log(SUDDEN_CHANGE_PROBABILITY)
        # Weights, also of the unknown place
        noise = self.settings.motion
        expected = [np.array([motion.mean for motion in each if motion.is_expected(noise)]) for each in motions]
        self._weigh_hypotheses(scan, hypotheses, expected, match.local_pose, period)
        self._scan = scan, observation
        # Global search
        self._scans_since_search += 1
        if is_motion_sudden:
            self._search_interval = 1
            return None
        if not self._may_be_elsewhere():
            self._search_interval = 1
        elif self._is_search_due(scan):
            return None
        return self._finish_scan(scan, observation)

    def search(self) -> Posterior:
        """Searches near the initial pose or in the whole map for the scan last given to `track`.

        Returns the posterior. Raises RuntimeError before the first scan.
        """
        if self._scan is None:
            raise RuntimeError("there is no scan to search with: call track first")
        scan, observation = self._scan
        start, is_first = self._start, not self.hypotheses
        # The map's errors are unknown until a key scan has shown them.
        likelihoods = [scan] if self._precision.scans else [scan, _with_rough_map(scan)]
        scan = self._search_for_hypotheses(likelihoods)
        if is_first and self._is_tracked():
            scan = self._search_with_map_error(scan, likelihoods[0].map_error, start)
        return self._finish_scan(scan, observation)

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """Predicts scans (see PoseEstimator).

        Sigma combines the configured noise of the scanner and the error that the model states, not what was learned.
        """
        expected = self.model.expect(se2.compose(poses, self.mount), angles)
        return self._predicted(expected.moved_back(self._precision.offset))

    def _scan_likelihood(self, observation: Observation) -> ScanLikelihood:
        """The scan with the noise and the map's errors as learned so far, corrected for motion and thinned."""
        likelihood = self._precision.update_noise(self.likelihood, observation.ranges, observation.angles)
        scan = ScanLikelihood(
            self.model,
            likelihood,
            self.mount,
            observation.angles,
            observation.ranges,
            observation.range_max,
            self._optimiser,
            self._precision.map_error,
            self._precision.correlated_fraction,
            self._precision.changed_fraction,
            self._precision.cell,
            self._precision.offset,
        )
        return self._correct_motion(
            scan, observation, self._velocity(self.hypotheses[0], observation) if self.hypotheses else None
        )

    def _correct_motion(
        self, scan: ScanLikelihood, observation: Observation, velocity: Array | None, displacements: Array | float = 0.0
    ) -> ScanLikelihood:
        """The likelihood of the observation, corrected for motion (see `correct_motion`), and thinned."""
        corrected = correct_motion(observation, velocity, self.mount, displacements)
        times = times_from_middle(observation) if velocity is not None else np.zeros(1)
        return replace(scan, angles=corrected.angles, ranges=corrected.ranges, times=times).thinned(TARGET_BEAMS)

    def _velocity(self, hypothesis: TrackedHypothesis, observation: Observation) -> Array | None:
        """Velocity (3,) in base_link from the last poses or else from odometry, or None if it is unknown."""
        if observation.is_earlier_than(self._stamp):
            return None
        odom = observation.odometry_since(self._odom)
        if hypothesis.velocity is not None or odom is None:
            return hypothesis.velocity
        return odom / self._period(observation)

    def _period(self, observation: Observation) -> float:
        """Time in s since the last scan."""
        return observation.period_since(self._stamp, self.settings.motion.period)

    def _predict_motion(
        self, hypothesis: TrackedHypothesis, period: float, odom: Array | None, command: Array | None
    ) -> list[MotionCandidate]:
        """Predicts the motions that the robot may have made since the last scan; the last one is the widest."""
        return predict_motion(
            self.settings.motion,
            hypothesis.pose,
            hypothesis.noise_covariance,
            period,
            odom,
            command,
            hypothesis.velocity,
            hypothesis.pose_slip_cross_covariance,
        )

    def _predict_local_motion(self, period: float, odom: Array | None, command: Array | None) -> list[MotionCandidate]:
        """Predicts the motions in the local frame, where the last pose is known far better than in the map."""
        last = replace(
            self.hypotheses[0],
            pose=self._local_pose,
            noise_covariance=np.zeros((3, 3)),
            pose_slip_cross_covariance=np.zeros((3, 3)),
        )
        return self._predict_motion(last, period, odom, command)

    def _match_map(
        self, scan: ScanLikelihood, motions: list[list[MotionCandidate]], period: float, *, with_odometry: bool
    ) -> ScanMatch:
        """Matches the scan to the map near the predicted pose of each hypothesis.

        If the map predicts it much worse than the last scan, searches a wider area for poses that fit it better.
        """
        widest = _prior_of([each[-1] for each in motions])
        predicted = np.array([expected_motion(each).mean for each in motions])
        poses, evidence = scan.descend(predicted, widest)
        if _log_fit(scan, poses) < self._last_log_fit - MAX_FIT_DROP_NATS:
            extra_starts = np.zeros((0, 3))
            if not with_odometry:
                extra_starts = reachable_poses(self.settings.motion, self.hypotheses[0].pose, period, COARSE_SIGMA_M)
            wider_poses, wider_evidence = search_around(scan, predicted, widest, extra_starts)
            fit = scan.surface_evidence(np.concatenate([poses, wider_poses])).log_likelihood.reshape(2, -1)
            chosen = np.arange(len(poses)) + len(poses) * (fit[1] > fit[0])
            poses = np.concatenate([poses, wider_poses])[chosen]
            evidence = Evidence.joined([evidence, wider_evidence]).part(chosen)
        return ScanMatch(scan, motions, poses, evidence)

    def _match_local_map(self, match: ScanMatch, motions: list[MotionCandidate], prior: Array) -> ScanMatch:
        """Matches the scan to the local map, and from the pose that this gives to the map again.

        ``motions`` are predicted in the local frame, so that an error of the pose in the map does not bias them; the
        pose of ``match`` is one more start there. ``prior`` (3, 3) is the covariance of the predicted pose in map.
        Returns ``match`` if the local map gives no motion, if surfaces have probably moved instead of the robot, or if
        the scan fits the map far better at the pose of ``match``.
        """
        scan = match.scan
        # Not the widest motion, whose mean is that of another.
        starts = np.array([*(each.mean for each in motions[:-1]), self._local_map.to_local(match.poses[0])])
        found = self._local_map.match(starts, scan, motions[-1])
        if found is None:
            return match
        # If surfaces have moved, the robot has moved as the map shows; otherwise as the local map does.
        by_map = match.evidence.curvature[0] + np.linalg.inv(match.motions[0][-1].covariance)
        noise = self.settings.motion
        cost_by_map = motion_cost(noise, match.motions[0], match.poses[0], _inverse(by_map))
        cost_by_local = motion_cost(noise, motions, found.pose, _inverse(found.information))
        moved_probability = found.moved_probability(self._moved_fraction.probability, cost_by_local - cost_by_map)
        if found.movable_surfaces and moved_probability > 0.5:
            return match
        moved = self._local_map.candidate(found, prior, moved_probability)
        # All hypotheses share the relative motion.
        step = se2.between(self.hypotheses[0].pose, moved.mean)
        moves = [replace(moved, mean=se2.compose(each.pose, step)) for each in self.hypotheses]
        poses, evidence = scan.descend(np.array([each.mean for each in moves]), _prior_of(moves))
        by_local_map = ScanMatch(scan, [[each] for each in moves], poses, evidence, found.pose)
        # The local map is wrong where people move all around the robot, the map where much has changed.
        both = np.stack([match.poses[0], poses[0]])
        map_evidence, local_evidence = _log_at_poses(
            scan, both, scan.surfaces.small, np.tile(self.hypotheses[0].surroundings, (2, 1))
        )[0]
        return match if map_evidence + np.log(LOCAL_MISMATCH_PROBABILITY) > local_evidence else by_local_map

    def _correct_motion_again(self, match: ScanMatch, observation: Observation, period: float) -> ScanMatch:
        """Corrects the scan for the motion that the match has shown, and matches it again.

        This is done twice, the second time also for the accelerations that the first has shown.
        """
        noise, prior = self.settings.motion, _prior_of([each[-1] for each in match.motions])
        times = times_from_middle(observation)
        limits, factors = acceleration_limits(noise, times, period), acceleration_factors(times, period)
        scan, poses, accelerations = match.scan, match.poses, np.zeros(6)
        for _ in range(2):
            # Not `between(last, this)`: beams are moved in base_link at this scan.
            velocity = -se2.between(poses[0], self.hypotheses[0].pose) / period
            in_base = accelerations.reshape(2, 3) @ se2.rotation(float(poses[0, 2]))
            scan = self._correct_motion(scan, observation, velocity, factors.T @ in_base)
            poses, _ = scan.descend(poses, prior)
            swept = SweptEvidence.from_scan(scan, poses, limits, period, accelerations)
            accelerations = swept.accelerations(0)
        return replace(match, scan=scan, poses=poses, evidence=swept.of_pose(), swept=swept)

    def _fuse(
        self, k: int, match: ScanMatch, predicted: list[MotionCandidate], observation: Observation
    ) -> tuple[TrackedHypothesis, MotionCandidate]:
        """Fuses the k-th hypothesis with the scan. Also returns the motion that the scan selected.

        An improbable motion, given those that were ``predicted``, is evidence for a kidnapping. Where the duration of
        the motion is unknown, this evidence is left out.
        """
        hypothesis, period = self.hypotheses[k], self._period(observation)
        candidates, pose = match.motions[k], match.poses[k]
        explained, unobserved = float(match.explained[k]), match.unobserved[k]
        # Where the map explains few beams, all of them may do so by chance, which is no information about the pose.
        not_by_chance = _fraction_not_by_chance(explained)
        evidence = project_evidence(match.evidence.at(k), unobserved).scaled(not_by_chance)
        # A match with the local map gives the motion in the unobserved directions, too.
        unknown_motion = len(unobserved) > 0 and match.local_pose is None
        if unknown_motion and observation.odometry_since(self._odom) is None:
            candidates = [
                widen_unobserved(self.settings.motion, each, unobserved, hypothesis.unobserved_scans, period)
                for each in candidates
            ]
            predicted = candidates
        fused = [
            fuse(
                limit_covariance(decouple(each, unobserved), self.seeds.spread),
                pose,
                evidence.xi[0],
                evidence.curvature[0],
            )
            for each in candidates
        ]
        best = min(fused, key=lambda each: each.negative_log_evidence)
        updated = update_hypothesis(hypothesis, best, evidence, period, unobserved=unknown_motion)
        # Standing still is the first candidate, unless the local map gives a single one.
        is_standing = len(fused) > 1 and best is fused[0]
        if match.swept is not None and not is_standing:
            mean_velocity = se2.between(hypothesis.pose, updated.pose) / period
            interpolated = pose_at_stamp(updated.pose, mean_velocity, period, observation)
            updated = replace(updated, displacement=match.swept.displacement(k, updated.pose, interpolated))
        if observation.is_earlier_than(self._stamp):
            updated = replace(updated, velocity=None)
        else:
            updated = replace(
                updated,
                motion_cost=self._motion_cost(predicted, updated),
                motion_complexity=motion_complexity(
                    [limit_covariance(each, self.seeds.spread) for each in predicted],
                    updated.pose,
                    updated.noise_covariance,
                ),
            )
        return updated, best.candidate

    def _find_alternatives(
        self, scan: ScanLikelihood, best: TrackedHypothesis, motion: MotionCandidate, predicted: list[MotionCandidate]
    ) -> list[TrackedHypothesis]:
        """Other hypotheses that fit the scan after the same ``motion``, if it made the ``best`` one far more certain.

        The pose was uncertain before this scan, and a descent from one pose finds only the nearest match. An
        alternative loses evidence if its motion is less probable than that of the best match, and gains none if it is
        more probable. What its motion, given those that were ``predicted``, costs more than that of the best match is
        subtracted in `_weigh_hypotheses`.
        """
        before = self.hypotheses[0]
        doubt = 1 - self._probability_of_being_near(before)
        certain = doubt <= 1 - TRACKING_PROBABILITY
        if certain or 1 - self._probability_of_being_near(best) > 0.5 * doubt:
            return []
        found = search_near([scan], motion.mean, motion.covariance, self.seeds, self._rng)
        at_best = before.log_evidence + _prior_of([motion]).energy(best.pose[None])[0]
        return [
            replace(
                each,
                log_evidence=min(before.log_evidence, at_best + each.log_evidence),
                motion_cost=self._motion_cost(predicted, each),
                surroundings=before.surroundings,
            )
            for each in found
        ]

    def _motion_cost(self, predicted: list[MotionCandidate], hypothesis: TrackedHypothesis) -> float:
        return motion_cost(self.settings.motion, predicted, hypothesis.pose, hypothesis.noise_covariance)

    def _weigh_hypotheses(
        self,
        scan: ScanLikelihood,
        hypotheses: list[TrackedHypothesis],
        expected: list[Array],
        local: Array | None,
        period: float,
    ) -> None:
        """Weighs hypotheses by how well the map predicts those surfaces of the scan that were not seen before.

        For each former hypothesis, ``expected`` has the poses (J, 3) after its expected motions. ``local`` (3,) is the
        pose in the local frame, or None if the motion does not come from the local map.
        """
        if local is None:
            local = self._local_map.to_local(hypotheses[0].pose)
        poses = np.array([each.pose for each in hypotheses])
        evidence, small = scan.surface_evidence(poses), scan.surfaces.small
        seen, appeared = self._find_seen_and_appeared(scan, local, evidence.weights[0] > 0.5)
        ignored = seen | appeared | small
        log_change = self._log_probability_of_changes(scan, local, appeared, period)
        before = np.array([each.surroundings for each in hypotheses])
        log_likelihood, surroundings = _log_at_poses(scan, poses, ignored, before)
        losses = self._losses_by_motion(scan, hypotheses, expected)
        if len(hypotheses) > len(self.hypotheses):
            with_seen, _ = _log_at_poses(scan, poses, appeared | small, before)
            losses += self._losses_of_alternatives(with_seen - log_likelihood)
        hypotheses = [
            replace(
                hypothesis,
                log_evidence=hypothesis.log_evidence - losses[k],
                explained=evidence.explained[k],
                scan_log_likelihood=log_likelihood[k] + log_change,
                scan_surroundings=surroundings[k],
            )
            for k, hypothesis in enumerate(hypotheses)
        ]
        self._local_pose, self._ignored_beams, self._log_change = local, ignored, log_change
        self._update_unknown_place(scan, hypotheses)
        self._set_hypotheses(hypotheses)
        if not np.array_equal(self.hypotheses[0].pose, hypotheses[0].pose):  # another hypothesis is best now
            self._local_map.place(local, self.hypotheses[0].pose)

    def _find_seen_and_appeared(
        self, scan: ScanLikelihood, local: Array, mapped: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """See `LocalMap.find_seen_and_appeared`. Also counts both among the surfaces that the map lacks."""
        seen, appeared = self._local_map.find_seen_and_appeared(local, scan, mapped)
        unmapped = scan.returned & ~mapped & ~scan.surfaces.small
        self._moved, self._stayed = scan.count_surfaces(unmapped & appeared), scan.count_surfaces(unmapped & seen)
        return seen, appeared

    def _log_probability_of_changes(
        self, scan: ScanLikelihood, local: Array, appeared: npt.NDArray[np.bool_], period: float
    ) -> float:
        """Log probability in nats of the changes since the last scan, and of the surfaces that have ``appeared`` (B,).

        They are equally probable at all hypotheses. If there are suddenly more changes, a search is due soon.
        """
        log_probability = 0.0  # of the number of changes
        if self._last:
            self._changes = count_changes(self._last, LocalScan(local, scan))
            log_probability = self._change_rate.log_probability(self._changes, period)
        if log_probability < np.log(SUDDEN_CHANGE_PROBABILITY):
            self._search_interval = 1
        return log_probability + _log_unmapped_surfaces(scan, ~appeared | scan.surfaces.small)

    def _losses_of_alternatives(self, log_of_seen: Array) -> Array:
        """Evidence (N,) in nats, at least 0, that the alternatives lose: the hypotheses found for this scan only.

        An alternative loses evidence if surfaces seen before fit it worse, but gains none if they fit it better,
        because the search may have missed the right match among similar surfaces. ``log_of_seen`` (N,) are the log
        likelihoods of these surfaces. The alternatives come last, and have no counterpart in `self.hypotheses`.
        """
        losses = np.maximum(0.0, log_of_seen[0] - log_of_seen)
        losses[: len(self.hypotheses)] = 0.0
        return np.asarray(losses)

    def _update_unknown_place(self, scan: ScanLikelihood, hypotheses: list[TrackedHypothesis]) -> None:
        """Updates the evidence for the unknown place, and that for a kidnapping, by the present scan.

        ``hypotheses`` are those after the scan, with the evidence of their motions.
        """
        log_kidnapping_prior = max(each.log_evidence for each in self.hypotheses)
        log_kidnapping_prior += float(np.log(UNKNOWN_PROBABILITY))
        # If the robot was carried away just now, no motion had to be predicted, but all surfaces of the scan are new.
        # This counts only together with the whole scan: in a search at this scan, and for places off the map.
        self._log_kidnapped = log_kidnapping_prior + hypotheses[0].motion_complexity
        pairs = zip(self.hypotheses, hypotheses, strict=False)
        unknown_place = self._unknown_place
        unknown_place.raise_evidence(max(self._log_mismatch(before, after) for before, after in pairs))
        # Either the surroundings have changed, or the robot was carried to another place and all surfaces are new.
        log_new = _log_unmapped_surfaces(scan, scan.surfaces.small)
        log_changed = _log_unmapped_surfaces(scan, self._ignored_beams) + self._log_change
        unknown_place.scan_log_likelihood = max(log_changed, log_new)
        unknown_place.raise_evidence(log_kidnapping_prior)
        unknown_place.add_kidnapping_off_map(self._log_kidnapped, log_new)

    def _losses_by_motion(
        self, scan: ScanLikelihood, hypotheses: list[TrackedHypothesis], expected: list[Array]
    ) -> Array:
        """By how much more the motion of each hypothesis costs than that of the best: (N,) nats, at least 0.

        A motion costs less where the pose is less certain; that does not speak for a hypothesis. For each former
        hypothesis, ``expected`` has the poses (J, 3) after its expected motions. Where the scan fits as well at one of
        these, the robot may be there, and did not jump.
        """
        costs = np.array([each.motion_cost for each in hypotheses])
        losses, count, small = np.maximum(0.0, costs - costs[0]), len(self.hypotheses), scan.surfaces.small
        if count > 1 and costs[:count].any():
            poses = np.array([each.pose for each in hypotheses])
            surroundings = np.array([each.surroundings for each in hypotheses])
            owner = np.repeat(np.arange(count), [len(each) for each in expected])
            fit = np.full(count, -np.inf)
            np.maximum.at(fit, owner, _log_at_poses(scan, np.concatenate(expected), small, surroundings[owner])[0])
            decrease = _log_at_poses(scan, poses, small, surroundings)[0][:count] - fit
            costs = np.clip(decrease, 0.0, costs[:count])
            losses[:count] = np.maximum(0.0, costs - costs[0])
        return np.asarray(losses)

    def _log_mismatch(self, before: TrackedHypothesis, after: TrackedHypothesis) -> float:
        """Evidence in nats that the scan was matched at a wrong pose.

        If it has made a pose certain that was uncertain ``before``, the probability gained may be due to a wrong match.
        """
        gained = self._probability_of_being_near(after) - self._probability_of_being_near(before)
        return before.log_evidence + (float(np.log(gained)) if gained > 0 else -np.inf)

    def _probability_of_being_near(self, hypothesis: TrackedHypothesis) -> float:
        return probability_of_being_near(self._covariance(hypothesis))

    def _set_hypotheses(self, hypotheses: list[TrackedHypothesis]) -> None:
        """Sets the hypotheses and their weights."""
        unknown = self._unknown_place
        min_log_unknown = max(each.log_weight for each in hypotheses) + float(np.log(UNKNOWN_PROBABILITY))
        log_unknown = max(unknown.log_evidence + unknown.scan_log_likelihood, min_log_unknown)
        self.hypotheses, unknown.weight = weigh(hypotheses, log_unknown)

    def _add_key_scan(self, scan: ScanLikelihood) -> None:
        """Makes the present scan a key scan: keeps its evidence, and adds its surfaces to the local map."""
        best, unknown = self.hypotheses[0], self._unknown_place
        mapped, tracked = scan.surface_evidence(best.pose[None]).weights[0] > 0.5, self._is_tracked()
        if tracked:
            self._precision.learn_changes(scan, best.pose)
            self._precision.learn_map_error(scan, best.pose)
        key = LocalMapScan(
            self._local_pose,
            scan,
            self._ignored_beams,
            mapped,
            tracked,
            self._log_change,
            unknown.log_evidence,
            unknown.log_arrival,
        )
        unknown.add_key_scan()
        self._local_map.add(key, best.pose, best.noise_covariance)
        self.hypotheses = [
            replace(
                each,
                log_evidence=each.log_weight,
                scan_log_likelihood=0.0,
                surroundings=each.scan_surroundings,
            )
            for each in self.hypotheses
        ]

    def _may_be_elsewhere(self) -> bool:
        """Whether the pose is uncertain, or another place could fit the scans much better."""
        best = self.hypotheses[0]
        if not self._is_tracked():
            return True
        # Prior against another place: the volume of all poses, divided by that of the poses at one place.
        information = best.curvature + np.linalg.inv(self.seeds.spread)
        log_places = np.log(self.seeds.volume) + 0.5 * (np.linalg.slogdet(information)[1] - 3 * np.log(2 * np.pi))
        unknown = max(
            [self._unknown_place.log_evidence, self._log_kidnapped, *(key.log_unknown for key in self._local_map.scans)]
        )
        return bool(best.log_weight <= unknown - log_places)

    def _is_search_due(self, scan: ScanLikelihood) -> bool:
        """Whether to search now: at growing intervals, and while not tracking also at each key scan."""
        if not scan.returned.any():  # as with a covered scanner: the search would find nothing
            return False
        if not self._is_tracked() and self._is_key_scan_due():
            return True
        return self._scans_since_search >= self._search_interval

    def _is_key_scan_due(self) -> bool:
        return self._local_map.is_key_scan_due(self._local_pose)

    def _search_for_hypotheses(self, likelihoods: list[ScanLikelihood]) -> ScanLikelihood:
        """Searches near the initial pose or in the whole map, and adds what is found to the hypotheses.

        ``likelihoods`` are those of the present scan with different errors of the map; returns the most probable one.
        """
        self._scans_since_search, self._search_interval = 0, min(2 * self._search_interval, MAX_SEARCH_INTERVAL_SCANS)
        if self._start is not None:
            start, self._start = self._start, None
            found = search_near(likelihoods, *start, self.seeds, self._rng)
            scan = _most_probable(likelihoods, found[0].pose)
            off_map = UNKNOWN_PROBABILITY * OFF_MAP_PROBABILITY
            self._start_with(scan, found, UNKNOWN_PROBABILITY, off_map, ALL_CHANGED_PROBABILITY)
            if not self._may_be_elsewhere():
                return scan
        found = self._search_everywhere(likelihoods)
        scan = _most_probable(likelihoods, found[0].pose)
        if self.hypotheses:
            self._add_hypotheses(found, scan)
            scan = _most_probable(likelihoods, self.hypotheses[0].pose)
            self._add_key_scan(scan)
        else:
            # After a search of the whole map, a robot that is at none of these places is off the map.
            self._start_with(scan, found, unknown=OFF_MAP_PROBABILITY, off_map=OFF_MAP_PROBABILITY)
        return scan

    def _search_with_map_error(
        self, scan: ScanLikelihood, assumed: float, start: tuple[Array, Array] | None
    ) -> ScanLikelihood:
        """Searches again if the first scan shows larger errors of the map than ``scan`` assumes, or another offset.

        If the error exceeds the one ``assumed`` before this scan, in m, it remains as improbable as it was. Returns the
        likelihood with these errors.
        """
        precision = replace(self._precision)
        if not precision.scans:
            precision.learn_map_error(scan, self.hypotheses[0].pose)
        error, offset = precision.map_error, precision.offset
        significant = SIGNIFICANT_MAP_ERROR * scan.likelihood.sigma
        if error < max(scan.map_error, significant) and abs(offset - scan.map_offset) < significant:
            return scan
        scan = replace(
            scan,
            map_error=error,
            correlated_fraction=precision.correlated_fraction,
            map_offset=offset,
            log_map_error_prior=scan.log_map_error_prior if error > np.hypot(assumed, significant) else 0.0,
        )
        self.hypotheses, self._start = [], start
        return self._search_for_hypotheses([scan])

    def _search_everywhere(self, likelihoods: list[ScanLikelihood]) -> list[TrackedHypothesis]:
        """The hypotheses in the whole map at which the scan is more probable than at an unknown place, or the best."""
        if self._precision.scans:  # the map's errors were learned in one room, but the robot may be in another
            elsewhere = self._precision.map_error_elsewhere
            likelihoods = [replace(scan, map_error=max(scan.map_error, elsewhere)) for scan in likelihoods]
        found, scan = search_everywhere(likelihoods, self.seeds), likelihoods[0]
        small = scan.surfaces.small
        log_at_unknown_place = scan.surfaces.log_density[~small].sum()
        return [each for each in found if each.scan_log_likelihood > log_at_unknown_place + MIN_GAIN_NATS] or found[:1]

    def _start_with(
        self,
        scan: ScanLikelihood,
        found: list[TrackedHypothesis],
        unknown: float,
        off_map: float,
        all_changed: float = 0.0,
    ) -> None:
        """Starts with the hypotheses ``found``, and the probability ``unknown`` that the robot is at none of them.

        It contains the probability ``off_map`` of a place that is not on the map. With the probability
        ``all_changed``, no surface is as the map shows it.
        """
        self._restart_local_map(scan)
        self._unknown_place.restart(unknown, off_map)
        reference = _log_reference(scan, self._ignored_beams)
        unknown_place = self._unknown_place
        log_all_changed = unknown_place.scan_log_likelihood + float(np.log(all_changed)) if all_changed else -np.inf
        log_likelihoods = [max(each.scan_log_likelihood - reference, log_all_changed) for each in found]
        self._set_hypotheses(
            [
                replace(hypothesis, scan_log_likelihood=each)
                for hypothesis, each in zip(found, log_likelihoods, strict=True)
            ]
        )

    def _restart_local_map(self, scan: ScanLikelihood) -> None:
        """Starts a new local map at the present scan."""
        self._local_map.clear()
        self._local_pose, self._ignored_beams, self._log_change = np.zeros(3), scan.surfaces.small, 0.0
        self._changes = self._moved = self._stayed = 0
        self._unknown_place.scan_log_likelihood = _log_unmapped_surfaces(scan, self._ignored_beams)

    def _add_hypotheses(self, found: list[TrackedHypothesis], scan: ScanLikelihood) -> None:
        """Adds hypotheses: the robot may have been there since one of the key scans, or was carried there just now."""
        if_stayed, surroundings = self._log_if_stayed(found, scan)
        log_likelihood = np.array([each.scan_log_likelihood for each in found])
        log_kidnapped = max(self._unknown_place.log_evidence, self._log_kidnapped)
        if_kidnapped = log_kidnapped + log_likelihood - _log_reference(scan, scan.surfaces.small)
        evidence = np.array([each.log_evidence for each in found]) + np.maximum(if_stayed, if_kidnapped)
        surroundings[if_kidnapped >= if_stayed] = SURROUNDINGS_PRIOR
        # In base_link, the motion is the same at all hypotheses. A robot that was carried has moved in an unknown way.
        velocity = self.hypotheses[0].velocity
        added = [
            replace(
                hypothesis,
                log_evidence=evidence[k],
                scan_log_likelihood=0.0,
                scan_surroundings=surroundings[k],
                velocity=velocity if if_stayed[k] > if_kidnapped[k] else None,
            )
            for k, hypothesis in enumerate(found)
        ]
        best = int(np.argmax(evidence))
        if evidence[best] > self.hypotheses[0].log_weight:
            self._search_interval = 1
            if if_kidnapped[best] > if_stayed[best]:
                self._restart_local_map(scan)
                unknown = self._unknown_place
                unknown.add_kidnapping_off_map(log_kidnapped, unknown.scan_log_likelihood)
        self._unknown_place.exclude_mapped_places()
        self._set_hypotheses([*self.hypotheses, *added])

    def _log_if_stayed(self, found: list[TrackedHypothesis], scan: ScanLikelihood) -> tuple[Array, Array]:
        """Evidence (N,) in nats if the robot has been at each hypothesis since one key scan, that with most evidence.

        Also returns the probabilities (N, 3) of the surroundings of the present scan in that case.
        """
        poses = np.array([each.pose for each in found])
        evidence = np.full((1, len(found)), -np.inf)  # the first row is for no key scan, then one row per key scan
        prior = np.tile(SURROUNDINGS_PRIOR, (1, len(found), 1))
        surroundings = prior
        for key in self._local_map.scans:
            evidence = np.vstack([evidence, np.full(len(found), key.log_arrival)])
            surroundings = np.vstack([surroundings, prior])
            at_key = se2.compose(poses, se2.between(self._local_pose, key.pose))
            gain, surroundings = _log_at_poses(key.scan, at_key, key.ignored, surroundings)
            evidence += gain + key.log_change
        gain, surroundings = _log_at_poses(scan, poses, self._ignored_beams, surroundings)
        evidence += gain + self._log_change
        best, columns = evidence.argmax(axis=0), np.arange(len(found))
        return evidence[best, columns], surroundings[best, columns]

    def _finish_scan(self, scan: ScanLikelihood, observation: Observation) -> Posterior:
        """Stores what the next scan needs, and returns the posterior."""
        self.hypotheses = clip_to_map(self.hypotheses, self.bounds)
        period = self._period(observation)
        poses = [
            pose_at_stamp(each.pose, self._velocity(each, observation), period, observation)
            if each.displacement is None
            else each.displacement.pose_at_stamp(each.pose)
            for each in self.hypotheses
        ]
        self._stamp, self._odom = observation.stamp, observation.odom
        # Only now, because nothing around the robot has changed if a search has shown that it was carried.
        self._change_rate.learn(self._changes, period)
        self._moved_fraction.learn(self._moved, self._stayed, period)
        self._changes = self._moved = self._stayed = 0
        if self._is_key_scan_due():
            self._add_key_scan(scan)
        self._last = LocalScan(self._local_pose, scan)
        self._last_log_fit = _log_fit(scan, self.hypotheses[0].pose[None])
        same_beams = np.array_equal(scan.angles, observation.angles)
        predicted = (
            self._predicted(scan.expected(poses[0])) if same_beams else self.predict(poses[0][None], observation.angles)
        )
        posterior = self._posterior(scan, poses, predicted)
        self._has_tracked |= posterior.state == "tracking"
        return posterior

    def _predicted(self, expected: Expected) -> Predicted:
        unknown = np.isinf(expected.scale)
        sigma = np.where(unknown, UNKNOWN_SIGMA_M, np.hypot(expected.scale, self.likelihood.deviation(expected.ranges)))
        return Predicted(np.where(unknown, np.inf, expected.ranges), sigma)

    def _posterior(self, scan: ScanLikelihood, poses: list[Array], predicted: Predicted) -> Posterior:
        """The posterior, with the hypotheses at their ``poses`` at the stamp of the scan."""
        best = self.hypotheses[0]
        error = EstimateError.from_scan(scan, best.pose, self._covariance_at_stamp(best), best.explained)
        covariances = [
            error.total_covariance(float(best.pose[2])),
            *map(self._covariance_at_stamp, self.hypotheses[1:]),
        ]
        hypotheses = tuple(
            Hypothesis(pose, covariance, hypothesis.weight)
            for pose, covariance, hypothesis in zip(poses, covariances, self.hypotheses, strict=True)
        )
        elsewhere = 1 - self._probability_at_best()
        return Posterior(
            state=self._state(),
            hypotheses=hypotheses,
            accuracy=best.accuracy,
            complexity=best.complexity,
            xi=best.xi,
            curvature=best.curvature,
            predicted=predicted.ranges[0],
            sigma=predicted.sigma[0],
            probability=self._probability(),
            protection=error.protection_level(elsewhere),
        )

    def _covariance(self, hypothesis: TrackedHypothesis) -> Array:
        floor = np.array([self.settings.floor_position] * 2 + [self.settings.floor_heading])
        return np.asarray(hypothesis.covariance(self.settings.inflation) + np.diag(floor**2))

    def _covariance_at_stamp(self, hypothesis: TrackedHypothesis) -> Array:
        covariance = self._covariance(hypothesis)
        if hypothesis.displacement is None:
            return covariance
        return hypothesis.displacement.covariance_at_stamp(covariance)

    def _probability(self) -> float:
        """Probability that the best hypothesis is within 0.2 m and 5 degrees of the truth."""
        return self._probability_at_best() * self._probability_of_being_near(self.hypotheses[0])

    def _probability_at_best(self) -> float:
        """Probability of the best hypothesis, also against the unknown place."""
        return self.hypotheses[0].weight * (1 - self._unknown_place.weight)

    def _is_tracked(self) -> bool:
        """Whether the best hypothesis is so probable that the state is `tracking`."""
        return self._probability() >= TRACKING_PROBABILITY

    def _state(self) -> State:
        if self._is_tracked():
            return "tracking"
        known = 1 - self._unknown_place.weight
        if len(self.hypotheses) > 1:
            tracked_alone = known * self._probability_of_being_near(self.hypotheses[0]) >= TRACKING_PROBABILITY
            if tracked_alone or self.hypotheses[1].weight * known > AMBIGUOUS_WEIGHT:
                return "ambiguous"
        return "lost" if self._has_tracked else "localising"


def _fraction_not_by_chance(explained: float) -> float:
    """Fraction of the explained beams that do not end at surfaces of the map by chance.

    ``explained`` is the fraction of all beams that the map explains.
    """
    real = max(0.0, explained - EXPLAINED_BY_CHANCE) / (1 - EXPLAINED_BY_CHANCE)
    return real / explained if real else 0.0


def _with_rough_map(scan: ScanLikelihood) -> ScanLikelihood:
    """The likelihood if the map's errors are larger than assumed."""
    return replace(
        scan,
        map_error=float(np.hypot(scan.map_error, ROUGH_MAP_ERROR_M)),
        correlated_fraction=1.0,
        log_map_error_prior=float(np.log(ROUGH_MAP_PROBABILITY)),
    )


def _most_probable(likelihoods: list[ScanLikelihood], pose: Array) -> ScanLikelihood:
    """The most probable at ``pose`` (3,) of a scan's ``likelihoods`` with different errors of the map."""
    return max(
        likelihoods, key=lambda scan: scan.log_map_error_prior + scan.surface_evidence(pose[None]).log_likelihood[0]
    )


def _log_reference(scan: ScanLikelihood, skip: npt.NDArray[np.bool_]) -> float:
    """Log likelihood in nats of the scan, without the beams in ``skip`` (B,), if all surfaces were known.

    The next functions return likelihoods relative to this reference.
    """
    return float(scan.surfaces.known_log_density[~skip].sum())


def _log_fit(scan: ScanLikelihood, poses: Array) -> float:
    """Log likelihood in nats of all beams at the first of the ``poses`` (N, 3), minus `_log_reference`."""
    return float(scan.surface_evidence(poses).log_likelihood[0] - scan.surfaces.known_log_density.sum())


def _log_unmapped_surfaces(scan: ScanLikelihood, skip: npt.NDArray[np.bool_]) -> float:
    """Log likelihood in nats, minus `_log_reference`, if the map shows none of the surfaces."""
    return float((scan.surfaces.log_density - scan.surfaces.known_log_density)[~skip].sum())


def _log_at_poses(
    scan: ScanLikelihood, poses: Array, skip: npt.NDArray[np.bool_], surroundings: Array
) -> tuple[Array, Array]:
    """Log likelihoods (..., N) in nats, minus `_log_reference`, at ``poses`` (N, 3) in the map.

    Each is a mixture over the three kinds of surroundings (see `SURROUNDINGS_PRIOR`); in clutter and in a room that the
    map lacks, a scan is equally likely at all poses. ``surroundings`` (..., N, 3) are their probabilities at the
    previous key scan. Also returns those at this scan.
    """
    mapped = scan.surface_evidence(poses).without(skip) - _log_reference(scan, skip)
    unmapped = np.full_like(mapped, _log_unmapped_surfaces(scan, skip))
    with np.errstate(divide="ignore"):
        logs = np.log(surroundings @ SURROUNDINGS_TRANSITIONS) + np.stack([mapped, unmapped, unmapped], axis=-1)
    total = np.logaddexp.reduce(logs, axis=-1)
    return total, np.exp(logs - total[..., None])


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), float)


def _prior_of(candidates: list[MotionCandidate]) -> Prior:
    return Prior(
        np.array([each.mean for each in candidates]), np.array([np.linalg.inv(each.covariance) for each in candidates])
    )
