"""The precise estimator: predict, match, associate, fuse, rank, search, publish."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise import continuity, obstruction
from services.estimator.precise.continuity import Continuity
from services.estimator.precise.gauss_newton import COARSE_SIGMA_M, GaussNewton, Optimiser, Prior, View
from services.estimator.precise.hypotheses import (
    SAME_POSITION_M,
    Mode,
    clip_to_map,
    observed_directions,
    project_evidence,
    rank_hypotheses,
    same_place,
    update_mode,
)
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import (
    Candidate,
    fuse,
    limit_to_map,
    predict_motion,
    reachable_poses,
    widen_unobserved,
)
from services.estimator.precise.search import search_around, search_everywhere, search_near
from services.estimator.precise.settings import Settings
from services.estimator.shared.interface import Hypothesis, Observation, Posterior, Predicted, State

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.global_seeds import Seeds
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.shared.generative_models import Expected, GenerativeModel

# Scans between two searches while scans fit badly: the interval doubles from the first to the longest.
FIRST_SEARCH_INTERVAL, MAX_SEARCH_INTERVAL = 5, 150
MAX_INTERVAL_IF_LOST, MAX_INTERVAL_IF_DOUBTFUL = 2, 8
UNKNOWN_SIGMA_M = 100.0  # published where the model does not know what to expect
TARGET_BEAMS = 2000  # a scan with at least twice as many is thinned, because the time of a search grows with the beams
AVERAGE_UPDATE_SHARE = 0.1  # weight of the present scan in the averages of inlier ratio and accuracy


class PreciseEstimator:
    """Estimator whose error is near the limit set by the scanner's noise (docs/precise.md)."""

    name = "precise"

    def __init__(
        self,
        model: GenerativeModel,
        seeds: Seeds,
        mount: Array,
        likelihood: Likelihood | None = None,
        settings: Settings | None = None,
        rng: np.random.Generator | None = None,
        bounds: tuple[float, float, float, float] | None = None,
        optimiser: Optimiser | None = None,
    ) -> None:
        """``mount`` (3,) is the laser in base_link; ``rng`` places the starts of a search near a given pose.

        The belief stays within ``bounds``, the map's x0, y0, x1, y1 in m.
        """
        self.model, self.seeds, self.mount = model, seeds, np.array(mount, float)
        self.likelihood, self.settings = likelihood or Likelihood(), settings or Settings()
        self.bounds = bounds or (-np.inf, -np.inf, np.inf, np.inf)
        self._rng = rng or np.random.default_rng(0)
        self._optimiser = optimiser or GaussNewton()
        self.restart()

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Starts from ``pose`` within ``covariance`` (default 0.5 m, 0.5 m, 0.3 rad), or from an unknown pose."""
        self.modes: list[Mode] = []
        self._initial: tuple[Array, Array] | None = None
        if pose is not None:
            spread = np.diag([0.25, 0.25, 0.09]) if covariance is None else np.asarray(covariance, float)
            self._initial = (np.asarray(pose, float), spread)
        self._was_tracking = False
        self._stamp: float | None = None
        self._odom: Array | None = None
        self._mean_inlier_ratio, self._mean_accuracy = 1.0, 0.0  # of the last scans
        self._poor_scans, self._search_interval = 0, FIRST_SEARCH_INTERVAL
        self._was_believed = False  # at the last scan
        self._continuity = Continuity(self.mount)
        self._pose_from_scans = False  # by matching recent scans, since the model explains too little
        self._scan: tuple[View, Observation] | None = None  # the present one

    def update(self, observation: Observation) -> Posterior:
        """Returns the posterior after one more scan."""
        posterior = self.track(observation)
        return self.search() if posterior is None else posterior

    def track(self, observation: Observation) -> Posterior | None:
        """Returns the posterior after one more scan, or None if the scan cannot be explained without a `search`."""
        view = View(
            self.model,
            self.likelihood,
            self.mount,
            observation.angles,
            observation.ranges,
            observation.range_max,
            self._optimiser,
        ).thinned(TARGET_BEAMS)
        period = self._period(observation.stamp)
        self._continuity.begin_scan(self.settings.motion.speed * period)
        if self.modes:
            odom = self._odometry_since_last_scan(observation)
            candidates = [self._predict(mode, period, odom, observation.command) for mode in self.modes]
            poses, evidence = self._match(view, candidates, period, odom)
            candidates, poses, evidence = self._associate(view, candidates, poses, evidence)
            modes = [self._fuse(view, k, candidates[k], poses[k], evidence, period, odom) for k in range(len(poses))]
            self.modes = rank_hypotheses(modes, self.settings)
        self._scan = view, observation
        if not self.modes or self._needs_search(view):
            return None
        return self._publish(view, observation)

    def search(self) -> Posterior:
        """Searches near the initial pose or in the whole map for the scan last given to `track`.

        Returns the posterior. Raises RuntimeError before the first scan.
        """
        if self._scan is None:
            raise RuntimeError("there is no scan to search with: call track first")
        view, observation = self._scan
        self._relocalise(view)
        return self._publish(view, observation)

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """Predicts scans (see Estimator); sigma combines the scanner's noise and the model's stated error."""
        expected = self.model.expect(se2.compose(poses, self.mount), angles)
        unknown = np.isinf(expected.scale)
        sigma = np.where(unknown, UNKNOWN_SIGMA_M, np.hypot(expected.scale, self.likelihood.deviation(expected.ranges)))
        return Predicted(np.where(unknown, np.inf, expected.ranges), sigma)

    def _odometry_since_last_scan(self, observation: Observation) -> Array | None:
        if observation.odom is None or self._odom is None:
            return None
        return se2.between(self._odom, observation.odom)

    def _predict(self, mode: Mode, period: float, odom: Array | None, command: Array | None) -> list[Candidate]:
        """Predicts the motions that the robot may have made since the last scan; the last one is the widest."""
        return predict_motion(
            self.settings.motion, mode.pose, mode.noise_covariance, period, odom, command, mode.velocity
        )

    def _match(
        self, view: View, candidates: list[list[Candidate]], period: float, odom: Array | None
    ) -> tuple[Array, Evidence]:
        """Matches the scan near the predicted pose of each hypothesis, over a wider area if it fits badly there."""
        starts = np.array([motions[-2].mean for motions in candidates])
        widest = Prior(
            np.array([motions[-1].mean for motions in candidates]),
            np.array([np.linalg.inv(motions[-1].covariance) for motions in candidates]),
        )
        poses, evidence = view.polish(starts, widest)
        if evidence.inlier_ratio[0] < self._mean_inlier_ratio - self.settings.inlier_ratio_drop:
            extra_starts = np.zeros((0, 3))
            if odom is None:
                extra_starts = reachable_poses(self.settings.motion, self.modes[0].pose, period, COARSE_SIGMA_M)
            wider_poses, wider_evidence = search_around(view, starts, widest, extra_starts)
            if wider_evidence.inlier_ratio[0] > evidence.inlier_ratio[0]:
                return wider_poses, wider_evidence
        return poses, evidence

    def _associate(
        self, view: View, candidates: list[list[Candidate]], poses: Array, evidence: Evidence
    ) -> tuple[list[list[Candidate]], Array, Evidence]:
        """Decides whether the scan shows the map or changed surroundings, where recent scans give the pose."""
        matched = self._match_recent_scans(view, evidence, candidates[0], poses[0])
        if matched is None:
            return candidates, poses, evidence
        # Not a kidnapping: scan matching confirms continuity, so the scene has changed.
        return [[matched]], *continuity.refine_in_changed_scene(view, matched, self.settings)

    def _fuse(
        self,
        view: View,
        k: int,
        candidates: list[Candidate],
        pose: Array,
        evidence: Evidence,
        period: float,
        odom: Array | None,
    ) -> Mode:
        """Fuses the k-th hypothesis with its evidence, which was found at ``pose`` (3,)."""
        mode = self.modes[k]
        # While a direction is unobserved, a ripple a little larger than the others must not pass for a feature.
        caution = 3 if mode.unobserved_scans else 1
        projection, unobserved = observed_directions(evidence.curvature[k], self.model.ripple * caution)
        min_beams = caution * self.settings.min_constraining_ratio * len(view.angles)
        if unobserved is not None and obstruction.constraining_beams(view, pose, unobserved) > min_beams:
            projection, unobserved = np.eye(3), None
        project_evidence(evidence, k, projection)
        is_unobserved = unobserved is not None and not self._pose_from_scans
        if unobserved is not None and is_unobserved and odom is None:
            candidates = [
                widen_unobserved(self.settings.motion, each, unobserved, mode.unobserved_scans, period)
                for each in candidates
            ]
        fused = [
            fuse(limit_to_map(each, self.seeds.spread), pose, evidence.xi[k], evidence.curvature[k])
            for each in candidates
        ]
        best = min(fused, key=lambda each: each.surprise)
        return update_mode(mode, best, evidence, k, period, unobserved=is_unobserved)

    def _match_recent_scans(
        self, view: View, evidence: Evidence, candidates: list[Candidate], start: Array
    ) -> Candidate | None:
        """Returns the pose that recent scans give, if the model does not explain the scan; else None."""
        settings, inlier_ratio = self.settings, float(evidence.inlier_ratio[0])
        pose_was_from_scans, self._pose_from_scans = self._pose_from_scans, False
        weak = inlier_ratio < max(settings.good_inlier_ratio, self._mean_inlier_ratio - settings.inlier_ratio_drop)
        inconclusive = inlier_ratio < settings.conclusive_inlier_ratio
        if not self.modes[0].tracked or not (weak or (pose_was_from_scans and inconclusive)):
            return None
        expected = self._expected(view, start)
        if inlier_ratio >= settings.min_occluded_inlier_ratio and obstruction.is_only_blocked(
            view, expected, settings.max_contradicting_ratio
        ):
            return None
        matched = self._continuity.match(candidates, start, view.points, obstruction.behind_ratio(view, expected))
        if matched is None or (not weak and continuity.is_consistent(start, matched)):
            return None
        self._pose_from_scans = True
        return matched

    def _remember_scan(self, view: View, best: Mode) -> None:
        """Stores the scan for matching, if its pose is known; forgets all scans if the pose is not tracked."""
        explained = best.inlier_ratio >= self.settings.good_inlier_ratio
        if not best.tracked:
            self._pose_from_scans = False
            self._continuity.reset()
        elif self._pose_from_scans or explained:
            self._continuity.add(best.pose, self._covariance(best), view.points, explained=explained)

    def _needs_search(self, view: View) -> bool:
        """Whether the scan suddenly fits worse, has fitted badly for long, or fits too badly to be believed."""
        best, settings = self.modes[0], self.settings
        dropped = (
            best.inlier_ratio < self._mean_inlier_ratio - settings.inlier_ratio_drop
            or best.accuracy > self._mean_accuracy + settings.energy_jump_nats
        )
        if self._pose_from_scans:
            self._poor_scans += 1
            return self._poor_scans >= MAX_SEARCH_INTERVAL
        believable, doubtful = self._is_believable(view), self._is_doubtful(view)
        if best.inlier_ratio >= settings.conclusive_inlier_ratio:
            self._poor_scans, self._search_interval = 0, FIRST_SEARCH_INTERVAL
            return dropped
        if not believable and not best.tracked:
            return True
        if self._was_believed and not believable:
            self._poor_scans, self._search_interval = 0, 1  # search at once, and soon again
        self._poor_scans += 1
        longest = MAX_SEARCH_INTERVAL
        if not believable:
            longest = MAX_INTERVAL_IF_LOST
        elif doubtful:
            longest = MAX_INTERVAL_IF_DOUBTFUL
        return dropped or self._poor_scans >= min(self._search_interval, longest)

    def _is_believable(self, view: View) -> bool:
        """Whether the model explains enough of the scan, or the rest may be occluded."""
        return self.modes[0].inlier_ratio >= self.settings.min_inlier_ratio or self._is_occluded(view)

    def _is_continuous(self, view: View) -> bool:
        """Whether the robot was tracked and the scan continues those before it."""
        best = self.modes[0]
        if self._pose_from_scans or not best.tracked or best.inlier_ratio < self.settings.good_inlier_ratio:
            return self._pose_from_scans
        behind_ratio = obstruction.behind_ratio(view, self._expected(view, best.pose))
        candidates = [continuity.candidate_at(best.pose)]
        return self._continuity.match(candidates, best.pose, view.points, behind_ratio) is not None

    def _expected(self, view: View, pose: Array) -> Expected:
        return view.model.expect(se2.compose(pose, view.mount)[None], view.angles)

    def _is_occluded(self, view: View) -> bool:
        """Whether the pose was tracked, the model still explains a few beams, and few beams contradict it."""
        best, settings = self.modes[0], self.settings
        partly_visible = best.tracked and best.inlier_ratio >= settings.min_occluded_inlier_ratio
        return partly_visible and self._contradicting_ratio(view) <= settings.max_contradicting_ratio

    def _is_doubtful(self, view: View) -> bool:
        """Whether the model explains little of the scan, and too many beams contradict the pose."""
        settings = self.settings
        explains_little = self.modes[0].inlier_ratio < settings.doubtful_inlier_ratio
        return explains_little and self._contradicting_ratio(view) > settings.max_contradicting_ratio

    def _contradicting_ratio(self, view: View) -> float:
        return obstruction.contradicting_ratio(view, self._expected(view, self.modes[0].pose))

    def _relocalise(self, view: View) -> None:
        """Searches near the initial pose or in the whole map; keeps the hypotheses if nothing better is found."""
        if self._initial is not None:
            initial, self._initial = self._initial, None
            found = search_near(view, *initial, self.seeds, self.settings, self._rng)
            if found[0].inlier_ratio >= self.settings.min_inlier_ratio:
                # A pose that was given counts as tracked until now.
                found[0] = replace(found[0], tracked=True)
                self._continuity.reset(pose_given=True)
        else:
            found = self._search(view)
        if self.modes:
            previous = self.modes[0]
            # Not the average alone, which still includes scans that fitted better.
            energy = max(previous.energy, previous.accuracy + previous.complexity)
            worse = found[0].energy > energy - 3 * self.settings.evidence_error_nats
            if worse or self._is_implausible_jump(view, found[0]):
                # The place has changed, or the model errs here: keep the hypotheses and search again later.
                found = self.modes
                self._double_search_interval()
            elif same_place(found[0].pose[None], previous.pose)[0]:
                found[0] = replace(found[0], age=previous.age, velocity=previous.velocity, tracked=previous.tracked)
            elif previous.tracked:
                found = [*self.modes, *found]
                self._double_search_interval()
        self.modes = rank_hypotheses(found, self.settings)
        self._mean_inlier_ratio, self._mean_accuracy = self.modes[0].inlier_ratio, self.modes[0].accuracy

    def _double_search_interval(self) -> None:
        self._poor_scans, self._search_interval = 0, min(2 * self._search_interval, MAX_SEARCH_INTERVAL)

    def _is_implausible_jump(self, view: View, found: Mode) -> bool:
        """Whether ``found`` is elsewhere, although nothing contradicts the tracked pose.

        This happens where a door was shut or people gather.
        """
        if not (self._is_continuous(view) or self._is_occluded(view)):
            return False
        best = self.modes[0]
        covariance = self._covariance(best)[:2, :2] + np.eye(2) * SAME_POSITION_M**2
        off = found.pose[:2] - best.pose[:2]
        return bool(off @ np.linalg.solve(covariance, off) > continuity.MAX_SQUARED_DISTANCE)

    def _search(self, view: View) -> list[Mode]:
        best = self.modes[0] if self.modes else None
        # A tracked pose that still fits well need not compete with poses that are hard to find.
        fits = best is not None and best.tracked and best.inlier_ratio >= self.settings.good_inlier_ratio
        return search_everywhere(view, self.seeds, self.settings, thorough=not fits)

    def _period(self, stamp: float | None) -> float:
        if stamp is None or self._stamp is None or stamp <= self._stamp:
            return self.settings.motion.period
        return stamp - self._stamp

    def _publish(self, view: View, observation: Observation) -> Posterior:
        """Stores what the next scan needs, and returns the posterior."""
        self.modes = clip_to_map(self.modes, self.bounds)
        self._stamp, self._odom = observation.stamp, observation.odom
        best = self.modes[0]
        self._remember_scan(view, best)
        self._mean_inlier_ratio += AVERAGE_UPDATE_SHARE * (best.inlier_ratio - self._mean_inlier_ratio)
        self._mean_accuracy += AVERAGE_UPDATE_SHARE * (best.accuracy - self._mean_accuracy)
        predicted = self.predict(best.pose[None], observation.angles)
        believable = self._is_believable(view)
        self._was_believed = believable or self._pose_from_scans
        state = self._state(view, best, believable=believable)
        unknown = self.seeds.spread * (not self._was_believed)
        hypotheses = tuple(Hypothesis(mode.pose, self._covariance(mode) + unknown, mode.weight) for mode in self.modes)
        return Posterior(
            state=state,
            hypotheses=hypotheses,
            accuracy=best.accuracy,
            complexity=best.complexity,
            xi=best.xi,
            curvature=best.curvature,
            predicted=predicted.ranges[0],
            sigma=predicted.sigma[0],
        )

    def _covariance(self, mode: Mode) -> Array:
        floor = np.array([self.settings.floor_position] * 2 + [self.settings.floor_heading])
        return np.asarray(mode.covariance(self.settings.inflation) + np.diag(floor**2))

    def _state(self, view: View, best: Mode, *, believable: bool) -> State:
        settings = self.settings
        if not believable:
            return "lost" if self._was_tracking else "localising"
        if len(self.modes) > 1 and self.modes[1].weight > settings.ambiguous_weight:
            return "ambiguous"
        if best.tracked and self._is_doubtful(view):
            return "lost"
        variance = np.linalg.eigvalsh(self._covariance(best)[:2, :2])[-1]
        if variance > settings.max_tracking_deviation**2:
            return "localising"
        proven = (
            best.tracked
            or best.inlier_ratio >= settings.tracking_inlier_ratio
            or (
                best.age >= settings.min_scans_before_tracking
                and self._contradicting_ratio(view) <= settings.max_contradicting_ratio
            )
        )
        if not proven:
            return "localising"
        self._was_tracking = True
        self.modes[0] = replace(best, tracked=True)
        return "tracking"
