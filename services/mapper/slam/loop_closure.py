"""Loop closures: links between submaps that saw the same place at different times.

The uncertainty of the pose graph limits the search. A match counts only if neither submap saw through the surfaces of
the other, and, if the search was wide, only together with another match that agrees (Mangelson et al. 2018).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from services.mapper.slam.correlative_search import correlative_search
from services.mapper.slam.pose_graph import PoseLink, Uncertainty
from services.mapper.slam.registration import Surface, register
from services.mapper.slam.submaps import Agreement, Submap, compare_submaps, merge_with_neighbours

MAX_DISTANCE_M = 6.0  # between the references of submaps that are matched
MIN_APART = 3  # submaps that are closer than this in the sequence are not matched
MAX_TARGETS = 2  # submaps with which one submap is matched in one round
SEARCH_SIGMAS = 3.0  # half the width of the search window, in standard deviations of the graph
NO_SEARCH_WINDOW = np.array([0.3, 0.3, 0.1])  # m, m, rad: a smaller window needs no search
MIN_MATCHED, MIN_AGREEING_FRACTION = 60, 0.85  # elements, and their fraction of those that agree or contradict
RIVAL_SHARE = 0.8  # of the best score: a better match at another place means that the place is not unique
SAME_PLACE_M, SAME_PLACE_RAD = 0.3, 0.15  # two matches that differ by more are of different places
MAX_SQUARED_DEVIATION = 16.3  # chi squared with three degrees of freedom, 0.1 %
# Standard deviations of a match beyond its noise: the submap is not quite rigid.
MATCH_DEVIATION = np.array([0.01, 0.01, 0.003])


@dataclass(frozen=True)
class LoopClosure:
    """A match of one submap with another."""

    first: int  # submap
    second: int
    link: PoseLink
    wide: bool  # found by a wide search


def find_closures(
    submaps: Sequence[Submap],
    poses: Array,
    uncertainty: Uncertainty,
    tried: set[tuple[int, int]],
    unconfirmed: Sequence[LoopClosure],
    window: float,
    report: Callable[[float], None] = lambda _done: None,
) -> tuple[list[LoopClosure], list[LoopClosure]]:
    """Closures between pairs of submaps whose position relative to one another is known to within ``window`` m.

    ``poses`` (N, 3) are of the key scans, ``uncertainty`` that of the submaps' references, ``tried`` the pairs
    that were tried before, and ``unconfirmed`` the closures found then that no other one supported. Returns the
    confirmed closures, and those that are still unconfirmed.
    """
    found, places = list(unconfirmed), poses[[submap.reference for submap in submaps]]
    for second in range(len(submaps)):
        report(second / len(submaps))
        for first in _targets(second, places, uncertainty, window, tried):
            tried.add((first, second))
            closure = _close_loop(submaps, first, second, poses, uncertainty)
            if closure is not None:
                found.append(closure)
    confirmed: list[LoopClosure] = []
    still_unconfirmed: list[LoopClosure] = []
    for closure in found:
        (confirmed if _is_confirmed(closure, found, poses, uncertainty) else still_unconfirmed).append(closure)
    return confirmed, still_unconfirmed


def _targets(
    second: int, places: Array, uncertainty: Uncertainty, window: float, tried: set[tuple[int, int]]
) -> list[int]:
    """Earlier submaps near ``second``, nearest first, apart from one another."""
    distance = np.hypot(*(places[: max(0, second - MIN_APART + 1), :2] - places[second, :2]).T)
    chosen: list[int] = []
    for first in np.argsort(distance):
        if distance[first] > MAX_DISTANCE_M + window or len(chosen) == MAX_TARGETS:
            break
        if (int(first), second) in tried or not uncertainty.linked(int(first), second):
            continue
        if any(abs(first - other) < MIN_APART for other in chosen):
            continue
        deviation = SEARCH_SIGMAS * float(
            np.sqrt(np.linalg.eigvalsh(uncertainty.of_pair(int(first), second)[:2, :2])[1])
        )
        if deviation < window and distance[first] < MAX_DISTANCE_M + deviation:
            chosen.append(int(first))
    return chosen


@dataclass(frozen=True)
class SubmapMatch:
    """A pose at which one submap matches another."""

    agreement: Agreement
    pose: Array  # (3,) of the second submap in the first
    covariance: Array  # (3, 3)

    @property
    def score(self) -> float:
        """Number of matched elements, less where others contradict."""
        return self.agreement.matched * self.agreement.agreeing_fraction

    @property
    def is_good(self) -> bool:
        """Whether enough elements match, and few contradict."""
        agreement = self.agreement
        return agreement.matched >= MIN_MATCHED and agreement.agreeing_fraction >= MIN_AGREEING_FRACTION

    def closure(self, first: int, second: int, references: tuple[int, int], *, wide: bool) -> LoopClosure:
        """The loop closure between two submaps with these ``references``."""
        link = PoseLink(*references, self.pose, np.asarray(np.linalg.inv(self.covariance), float), robust=True)
        return LoopClosure(first, second, link, wide)


def match_submaps(first: Submap, surface: Surface, second: Submap, start: Array) -> SubmapMatch | None:
    """Matches the second submap with the first from ``start`` (3,); ``surface`` has the elements of the first."""
    found = register(surface, second.elements, start)
    if found is None:
        return None
    covariance = np.linalg.inv(found.information + np.eye(3)) + np.diag(MATCH_DEVIATION**2)
    return SubmapMatch(compare_submaps(first, surface, second, found.pose), found.pose, np.asarray(covariance, float))


def _close_loop(
    submaps: Sequence[Submap], first: int, second: int, poses: Array, uncertainty: Uncertainty
) -> LoopClosure | None:
    """The closure between two submaps; None if they do not match well, or at several places."""
    target, source = merge_with_neighbours(submaps, first, poses), submaps[second]
    predicted = se2.between(poses[target.reference], poses[source.reference])
    covariance = uncertainty.of_pair(first, second)
    window = SEARCH_SIGMAS * np.sqrt(np.diag(covariance))
    wide = bool((window > NO_SEARCH_WINDOW).any())
    surface = Surface(target.elements)
    starts = [predicted]
    if wide:
        starts += list(correlative_search(surface.elements, source.elements, predicted, window))
    found = [match_submaps(target, surface, source, start) for start in starts]
    matches = [each for each in found if each is not None and _is_plausible(each, predicted, covariance)]
    if not matches:
        return None
    matches.sort(key=lambda each: -each.score)
    best = matches[0]
    if not best.is_good or any(_is_rival(each, best) for each in matches[1:]):
        return None
    return best.closure(first, second, (target.reference, source.reference), wide=wide)


def _is_plausible(match: SubmapMatch, predicted: Array, covariance: Array) -> bool:
    """Whether a match agrees with the pose (3,) that the graph predicts within ``covariance`` (3, 3)."""
    difference = se2.difference(match.pose, predicted)
    return bool(difference @ np.linalg.solve(covariance + match.covariance, difference) < MAX_SQUARED_DEVIATION)


def _is_rival(match: SubmapMatch, best: SubmapMatch) -> bool:
    """Whether a match is at another pose than the best one, and nearly as good."""
    dx, dy, turn = match.pose - best.pose
    elsewhere = bool(np.hypot(dx, dy) > SAME_PLACE_M or abs(se2.wrap(turn)) > SAME_PLACE_RAD)
    return match.score > RIVAL_SHARE * best.score and elsewhere


def _is_confirmed(closure: LoopClosure, others: Sequence[LoopClosure], poses: Array, uncertainty: Uncertainty) -> bool:
    """Whether a closure was found by a narrow search, or by a wide one and another closure supports it."""
    return not closure.wide or any(
        _supports(closure, other, poses, uncertainty) for other in others if other is not closure
    )


def _supports(a: LoopClosure, b: LoopClosure, poses: Array, uncertainty: Uncertainty) -> bool:
    """Whether two closures confirm one another: the loop through both closes, which would be unlikely by chance."""
    if not (uncertainty.linked(a.first, b.first) and uncertainty.linked(a.second, b.second)):
        return False
    # Either closure leads from a's first submap to b's second one: the pose of the latter in the frame of the former.
    by_a, covariance_by_a = _composed(
        (a.link.pose, np.asarray(np.linalg.inv(a.link.information), float)),
        (se2.between(poses[a.link.second], poses[b.link.second]), uncertainty.of_pair(a.second, b.second)),
    )
    by_b, covariance_by_b = _composed(
        (se2.between(poses[a.link.first], poses[b.link.first]), uncertainty.of_pair(a.first, b.first)),
        (b.link.pose, np.asarray(np.linalg.inv(b.link.information), float)),
    )
    off, covariance = se2.difference(by_a, by_b), covariance_by_a + covariance_by_b
    if (np.sqrt(np.diag(covariance)) > 2 * NO_SEARCH_WINDOW).any():
        return False
    return bool(off @ np.linalg.solve(covariance, off) < MAX_SQUARED_DEVIATION)


def _composed(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
    """The composition of two independent poses (3,), each with its covariance (3, 3)."""
    first_jacobian, second_jacobian = se2.compose_jacobians(first[0], second[0])
    covariance = first_jacobian @ first[1] @ first_jacobian.T + second_jacobian @ second[1] @ second_jacobian.T
    return se2.compose(first[0], second[0]), covariance
