"""Preset `precise`: natural-gradient descent on F from many places at once, a mixture, fusion over time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from common import se2
from services.estimator.interface import Hypothesis, Observation, Posterior, State
from services.estimator.precise import mixture
from services.estimator.precise.gauss_newton import Prior, View, descend, polish
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.mixture import Mode
from services.estimator.precise.motion import MotionNoise, candidates, fuse

if TYPE_CHECKING:
    from common.se2 import Array
    from services.estimator.generative import GenerativeModel
    from services.estimator.precise.seeding import Seeds

WIDEST, WIDE, NARROW = 0.3, 0.1, 0.03  # m, added to every beam's deviation on the way down from a seed


@dataclass(frozen=True)
class Settings:
    """What can be set; defaults hold for every shipped world."""

    seeds: int = 48  # poses descended in the first round of a search
    more_seeds: int = 240  # in the second, where the first explains too little
    beams: int = 150  # of the descent from seeds; the last steps take all
    satisfied: float = 0.9  # share of beams explained that ends a search
    believable: float = 0.45  # least share of beams that a belief must explain
    drop: float = 0.1  # fall of the share explained that calls for a search
    evidence_error: float = 20.0  # nats by which a model's error may set two places apart
    ambiguous: float = 0.05  # weight of a second hypothesis from which the belief is ambiguous
    hypotheses: int = 8
    correlation: float = 1.0  # of the model's error: beams that err alike
    motion: MotionNoise = field(default_factory=MotionNoise)


class PreciseEstimator:
    """Perception at the limit of the sensor."""

    name = "precise"

    def __init__(
        self,
        model: GenerativeModel,
        seeds: Seeds,
        mount: Array,
        likelihood: Likelihood | None = None,
        settings: Settings | None = None,
        rng: np.random.Generator | None = None,
    ) -> None:
        """``mount`` (3,) is the laser in base_link; ``rng`` only places the starts near a pose that is given."""
        self.model, self.seeds, self.mount = model, seeds, np.array(mount, float)
        self.likelihood, self.settings = likelihood or Likelihood(), settings or Settings()
        self._rng = rng or np.random.default_rng(0)
        self.restart()

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Begin anew, near ``pose`` with ``covariance`` (default 0.5 m, 0.5 m, 0.3 rad) or knowing nothing."""
        self.modes: list[Mode] = []
        self._near: tuple[Array, Array] | None = None
        if pose is not None:
            spread = np.diag([0.25, 0.25, 0.09]) if covariance is None else np.asarray(covariance, float)
            self._near = (np.asarray(pose, float), spread)
        self._was_tracking = False
        self._stamp: float | None = None
        self._odom: Array | None = None
        self._usual = 1.0  # share of beams explained lately
        self._searched_at = 1.0  # share explained when a search found nothing better; 1: none was made

    def update(self, observation: Observation) -> Posterior:
        """One more scan."""
        view = View(
            self.model, self.likelihood, self.mount, observation.angles, observation.ranges, observation.range_max
        )
        if self.modes:
            self._track(view, observation)
        if not self.modes or self._suspicious():
            self._relocalise(view)
        self._stamp, self._odom = observation.stamp, observation.odom
        best = self.modes[0]
        self._usual += 0.1 * (best.explained - self._usual)
        return self._posterior(view, best)

    def _track(self, view: View, observation: Observation) -> None:
        """Each hypothesis on: where it may have moved, where the scan says it is, both fused."""
        period = self._period(observation.stamp)
        odom = None
        if observation.odom is not None and self._odom is not None:
            odom = se2.between(self._odom, observation.odom)
        options = [
            candidates(self.settings.motion, mode.pose, mode.noise, period, odom, observation.command, mode.velocity)
            for mode in self.modes
        ]
        starts = np.array([each[-2].mean for each in options])
        wide = Prior(
            np.array([each[-1].mean for each in options]),
            np.array([np.linalg.inv(each[-1].covariance) for each in options]),
        )
        poses, evidence = polish(view, starts, wide)
        if evidence.explained[0] < self._usual - self.settings.drop:
            for widen in (WIDEST, WIDE, NARROW):
                starts, _ = descend(view, starts, wide, widen, 5)
            retried = polish(view, starts, wide)
            if retried[1].explained[0] > evidence.explained[0]:
                poses, evidence = retried
        modes = []
        for k, (mode, each) in enumerate(zip(self.modes, options, strict=True)):
            parts = [fuse(option, poses[k], evidence.xi[k], evidence.curvature[k]) for option in each]
            fused = min(parts, key=lambda part: part.surprise)
            modes.append(mixture.moved(mode, fused, evidence, k, period))
        self.modes = mixture.weigh(modes, self.settings.evidence_error, self.settings.hypotheses)

    def _suspicious(self) -> bool:
        """The best hypothesis explains less than it used to, or than a belief must; and a search may help."""
        share = self.modes[0].explained
        if share >= self._usual - self.settings.drop and share >= self.settings.believable:
            self._searched_at = 1.0
            return False
        return share < self._searched_at - self.settings.drop or share < self.settings.believable

    def _relocalise(self, view: View) -> None:
        """Search from nothing; keep what is tracked where nothing better is found."""
        if self._near is not None:
            found, self._near = self._search_near(view, *self._near), None
        else:
            found = self._search(view)
        if self.modes:
            margin = 3 * self.settings.evidence_error
            if found[0].energy > self.modes[0].energy - margin:
                self._searched_at = self.modes[0].explained
                return
        self.modes = found
        self._usual, self._searched_at = found[0].explained, 1.0

    def _search(self, view: View) -> list[Mode]:
        modes: list[Mode] = []
        for count in (self.settings.seeds, self.settings.more_seeds):
            modes = self._refine(view, self.seeds.rank(view, count), None)
            if modes[0].explained >= self.settings.satisfied:
                break
        return modes

    def _search_near(self, view: View, pose: Array, covariance: Array) -> list[Mode]:
        starts = self._rng.multivariate_normal(pose, covariance, self.settings.seeds)
        starts[0] = pose
        information = np.linalg.inv(covariance)
        return self._refine(
            view, starts, Prior(np.tile(pose, (len(starts), 1)), np.tile(information, (len(starts), 1, 1)))
        )

    def _refine(self, view: View, starts: Array, prior: Prior | None) -> list[Mode]:
        """Descend from all starts with few beams and wide deviations, then from the best with all and none."""
        few = view.thinned(self.settings.beams)
        poses, evidence = descend(few, starts, prior, WIDEST, 5)
        poses, evidence = descend(few, poses, prior, WIDE, 4)
        keep = mixture.distinct(poses, evidence.accuracy, 2 * self.settings.hypotheses)
        part = Prior(prior.mean[keep], prior.information[keep]) if prior else None
        poses, evidence = descend(view, poses[keep], part, NARROW, 4)
        poses, evidence = polish(view, poses, part)
        keep = mixture.distinct(poses, evidence.accuracy, self.settings.hypotheses)
        modes = [mixture.found(poses[k], evidence, k, part, self.seeds.volume) for k in keep]
        return mixture.weigh(modes, self.settings.evidence_error, self.settings.hypotheses)

    def _period(self, stamp: float | None) -> float:
        if stamp is None or self._stamp is None or stamp <= self._stamp:
            return self.settings.motion.period
        return stamp - self._stamp

    def _posterior(self, view: View, best: Mode) -> Posterior:
        expected = self.model.expect(se2.compose(best.pose, self.mount)[None], view.angles)
        hypotheses = tuple(
            Hypothesis(mode.pose, mode.covariance(self.settings.correlation), mode.weight) for mode in self.modes
        )
        return Posterior(
            self._state(best),
            hypotheses,
            best.accuracy,
            best.complexity,
            best.xi,
            best.curvature,
            expected.ranges[0],
            np.sqrt(expected.scale[0] ** 2 + self.likelihood.sigma**2),
        )

    def _state(self, best: Mode) -> State:
        if best.explained < self.settings.believable:
            return "lost" if self._was_tracking else "localising"
        if len(self.modes) > 1 and self.modes[1].weight > self.settings.ambiguous:
            return "ambiguous"
        self._was_tracking = True
        return "tracking"
