"""One update: predict, match, associate, fuse, rank, publish."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise import continuity, obstruction
from services.estimator.precise import hypotheses as mixture
from services.estimator.precise import search as searching
from services.estimator.precise.continuity import Continuity
from services.estimator.precise.gauss_newton import WIDEST, Prior, View, polishing
from services.estimator.precise.hypotheses import Mode
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.motion_model import Candidate, candidates, fuse, unseen, within_map, within_reach
from services.estimator.precise.settings import Settings
from services.estimator.shared.asking import Conversation, Search, alone
from services.estimator.shared.generative_models import Expect, Expected
from services.estimator.shared.interface import Hypothesis, Observation, Posterior, Predicted, State

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.global_seeds import Seeds
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.shared.generative_models import GenerativeModel

FIRST_WAIT, LONGEST_WAIT = 5, 150  # scans between searches while the scan fits badly,
LOST_WAIT, DOUBTFUL_WAIT = 2, 8  # at most that many while nothing, or little, speaks for the place
UNKNOWN = 100.0  # m, stated where nothing is known
ENOUGH_BEAMS = 2000  # of a scan with twice as many or more, every k-th is used: a search takes time for each beam


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
        bounds: tuple[float, float, float, float] | None = None,
    ) -> None:
        """``mount`` (3,) is the laser in base_link; ``rng`` only places the starts near a pose that is given.

        The belief stays within ``bounds``, x0, y0, x1, y1 of the map in m.
        """
        self.model, self.seeds, self.mount = model, seeds, np.array(mount, float)
        self.likelihood, self.settings = likelihood or Likelihood(), settings or Settings()
        self.bounds = bounds or (-np.inf, -np.inf, np.inf, np.inf)
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
        self._usual, self._energy = 1.0, 0.0  # share of beams explained, and accuracy, lately
        self._since, self._wait = 0, FIRST_WAIT  # scans that fitted badly, and after how many to search
        self._believed = False  # the last scan
        self._continuity = Continuity(self.mount)
        self._held = False

    def update(self, observation: Observation) -> Posterior:
        """One more scan."""
        return alone(self.updating(observation))

    def updating(self, observation: Observation) -> Conversation[Posterior]:
        """The same as a conversation: see `asking`."""
        view = View(
            self.model, self.likelihood, self.mount, observation.angles, observation.ranges, observation.range_max
        ).thinned(ENOUGH_BEAMS)
        self._continuity.passed(self.settings.motion.speed * self._period(observation.stamp))
        if self.modes:
            yield from self._track(view, observation)
        if not self.modes or self._suspicious(view):
            yield Search()
            yield from self._relocalise(view)
        self.modes = mixture.within(self.modes, self.bounds)
        self._stamp, self._odom = observation.stamp, observation.odom
        best = self.modes[0]
        self._remember(view, best)
        self._usual += 0.1 * (best.explained - self._usual)
        self._energy += 0.1 * (best.accuracy - self._energy)
        return (yield from self._posterior(view, best, observation.angles))

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """See Estimator; sigma is the scanner's noise and the model's stated error together."""
        return self._with_noise(self.model.expect(se2.compose(poses, self.mount), angles))

    def _with_noise(self, expected: Expected) -> Predicted:
        unknown = np.isinf(expected.scale)
        sigma = np.where(unknown, UNKNOWN, np.hypot(expected.scale, self.likelihood.deviation(expected.ranges)))
        return Predicted(np.where(unknown, np.inf, expected.ranges), sigma)

    def _track(self, view: View, observation: Observation) -> Conversation[None]:
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
        poses, evidence = yield from polishing(view, starts, wide)
        if evidence.explained[0] < self._usual - self.settings.drop:
            around = np.zeros((0, 3))
            if odom is None:
                around = within_reach(self.settings.motion, self.modes[0].pose, period, WIDEST)
            tried, retried = yield from searching.further(view, starts, wide, around)
            if retried.explained[0] > evidence.explained[0]:
                poses, evidence = tried, retried
        held = self._hold(view, evidence, options[0], poses[0])
        if held is not None:
            # Nobody has carried the robot off: what looks like another place is this one, changed.
            self.modes, options, evidence = self.modes[:1], [[held]], evidence.part(np.array([0]))
            poses, evidence = yield from continuity.looked_at(view, held, self.settings)
        modes = []
        for k, (mode, each) in enumerate(zip(self.modes, options, strict=True)):
            # Once blind, a ripple a little larger than the others must not be taken for a feature.
            doubt = 3 if mode.blind else 1
            keep, blind = mixture.seen(evidence.curvature[k], self.model.ripple * doubt)
            holding = doubt * self.settings.holding * len(view.angles)
            if blind is not None and obstruction.held(view, poses[k], blind) > holding:
                keep, blind = np.eye(3), None
            mixture.project(evidence, k, keep)
            if blind is not None and odom is None and held is None:
                each = [unseen(self.settings.motion, option, blind, mode.blind, period) for option in each]  # noqa: PLW2901
            each = [within_map(option, self.seeds.spread) for option in each]  # noqa: PLW2901
            parts = [fuse(option, poses[k], evidence.xi[k], evidence.curvature[k]) for option in each]
            fused = min(parts, key=lambda part: part.surprise)
            modes.append(mixture.moved(mode, fused, evidence, k, period, blind=blind is not None and held is None))
        self.modes = mixture.led(modes, self.settings)

    def _hold(self, view: View, evidence: Evidence, options: list[Candidate], start: Array) -> Candidate | None:
        """Where the scans of a moment ago say the robot is, if the model does not explain what is seen."""
        settings, explained = self.settings, float(evidence.explained[0])
        before, self._held = self._held, False
        weak = explained < max(settings.good, self._usual - settings.drop)
        if not self.modes[0].trusted or not (weak or (before and explained < settings.satisfied)):
            return None
        expected = self._expected(view, start)
        if explained >= settings.glimpse and obstruction.crowded(view, expected, settings.contradicted):
            return None
        held = self._continuity.hold(options, start, view.points, obstruction.late(view, expected))
        if held is None or (not weak and continuity.agree(start, held)):
            return None
        self._held = True
        return held

    def _remember(self, view: View, best: Mode) -> None:
        """For the scans to come: where this one was seen from, if that is known."""
        if not best.trusted:
            self._held = False
            self._continuity.forget()
        elif self._held or best.explained >= self.settings.good:
            explained = best.explained >= self.settings.good
            self._continuity.keep(best.pose, self._covariance(best), view.points, explained=explained)

    def _suspicious(self, view: View) -> bool:
        """The scan fits worse at once, or has fitted badly for long, or not as a belief must."""
        best, settings = self.modes[0], self.settings
        fell = best.explained < self._usual - settings.drop or best.accuracy > self._energy + settings.rise
        if self._held:
            self._since += 1
            return self._since >= LONGEST_WAIT
        believable, doubtful = self._believable(view), self._doubtful(view)
        if best.explained >= settings.satisfied:
            self._since, self._wait = 0, FIRST_WAIT
            return fell
        if not believable and not best.trusted:
            return True
        if self._believed and not believable:
            self._since, self._wait = 0, 1  # at once, and soon again
        self._since += 1
        longest = LOST_WAIT if not believable else DOUBTFUL_WAIT if doubtful else LONGEST_WAIT
        return fell or self._since >= min(self._wait, longest)

    def _believable(self, view: View) -> bool:
        """Whether enough of the scan is explained, or the rest may be hidden."""
        return self.modes[0].explained >= self.settings.believable or self._hidden(view)

    def _goes_on(self, view: View) -> bool:
        """Whether the robot was tracked and the scan goes on from those before it."""
        best = self.modes[0]
        if self._held or not best.trusted or best.explained < self.settings.good:
            return self._held
        late = obstruction.late(view, self._expected(view, best.pose))
        return self._continuity.hold([continuity.around(best.pose)], best.pose, view.points, late) is not None

    def _expected(self, view: View, pose: Array) -> Expected:
        return view.model.expect(se2.compose(pose, view.mount)[None], view.angles)

    def _hidden(self, view: View) -> bool:
        """Whether the place was tracked, shows a glimpse of itself still, and little contradicts it."""
        best, settings = self.modes[0], self.settings
        glimpsed = best.trusted and best.explained >= settings.glimpse
        return glimpsed and self._contradicted(view) <= settings.contradicted

    def _doubtful(self, view: View) -> bool:
        """Whether much of the scan is not explained, and some of it cannot be."""
        settings = self.settings
        return self.modes[0].explained < settings.doubtful and self._contradicted(view) > settings.contradicted

    def _contradicted(self, view: View) -> float:
        return obstruction.contradicted(view, self._expected(view, self.modes[0].pose))

    def _relocalise(self, view: View) -> Conversation[None]:
        """Search from nothing; keep what is tracked where nothing better is found."""
        if self._near is not None:
            near, self._near = self._near, None
            found = yield from searching.near(view, *near, self.seeds, self.settings, self._rng)
            if found[0].explained >= self.settings.believable:  # who says where it is has tracked it until now
                found[0] = replace(found[0], trusted=True)
                self._continuity.forget(given=True)
        else:
            found = yield from self._search(view)
        if self.modes:
            before = self.modes[0]
            now = max(before.energy, before.accuracy + before.complexity)  # the average still praises earlier scans
            worse = found[0].energy > now - 3 * self.settings.evidence_error
            if worse or self._unlikely(view, found[0]):
                found = self.modes  # nothing better: this is how it looks here now; search again later
                self._since, self._wait = 0, min(2 * self._wait, LONGEST_WAIT)
            elif mixture.same(found[0].pose[None], before.pose)[0]:
                found[0] = replace(found[0], age=before.age, velocity=before.velocity, trusted=before.trusted)
            elif before.trusted:
                found = [*self.modes, *found]
                self._since, self._wait = 0, min(2 * self._wait, LONGEST_WAIT)
        self.modes = mixture.led(found, self.settings)
        self._usual, self._energy = self.modes[0].explained, self.modes[0].accuracy

    def _unlikely(self, view: View, found: Mode) -> bool:
        """Elsewhere, though nothing contradicts the place that was tracked: a door has closed, a crowd has gathered."""
        if not (self._goes_on(view) or self._hidden(view)):
            return False
        best = self.modes[0]
        spread = self._covariance(best)[:2, :2] + np.eye(2) * mixture.SAME_PLACE**2
        off = found.pose[:2] - best.pose[:2]
        return bool(off @ np.linalg.solve(spread, off) > continuity.FAR)

    def _search(self, view: View) -> Conversation[list[Mode]]:
        # A place that is tracked and still fits somewhat need not be beaten by what is hard to find.
        held = bool(self.modes) and self.modes[0].trusted and self.modes[0].explained >= self.settings.good
        return (yield from searching.anywhere(view, self.seeds, self.settings, thorough=not held))

    def _period(self, stamp: float | None) -> float:
        if stamp is None or self._stamp is None or stamp <= self._stamp:
            return self.settings.motion.period
        return stamp - self._stamp

    def _posterior(self, view: View, best: Mode, angles: Array) -> Conversation[Posterior]:
        seen: Expected = yield Expect(self.model, se2.compose(best.pose[None], self.mount), angles)
        expected = self._with_noise(seen)
        believable = self._believable(view)
        self._believed = believable or self._held
        state = self._state(view, best, believable=believable)
        unknown = self.seeds.spread * (not self._believed)
        hypotheses = tuple(Hypothesis(mode.pose, self._covariance(mode) + unknown, mode.weight) for mode in self.modes)
        evidence = (best.accuracy, best.complexity, best.xi, best.curvature)
        return Posterior(state, hypotheses, *evidence, expected.ranges[0], expected.sigma[0])

    def _covariance(self, mode: Mode) -> Array:
        floor = np.array([self.settings.floor_position] * 2 + [self.settings.floor_heading])
        return np.asarray(mode.covariance(self.settings.inflation) + np.diag(floor**2))

    def _state(self, view: View, best: Mode, *, believable: bool) -> State:
        settings = self.settings
        if not believable:
            return "lost" if self._was_tracking else "localising"
        if len(self.modes) > 1 and self.modes[1].weight > settings.ambiguous:
            return "ambiguous"
        if best.trusted and self._doubtful(view):
            return "lost"
        vague = np.linalg.eigvalsh(self._covariance(best)[:2, :2])[-1] > settings.vague**2
        sure = best.trusted or best.explained >= settings.sure
        if vague or not (sure or (best.age >= settings.patience and self._contradicted(view) <= settings.contradicted)):
            return "localising"
        self._was_tracking = True
        self.modes[0] = replace(best, trusted=True)
        return "tracking"
