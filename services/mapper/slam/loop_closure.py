"""Loop closures: links between segments that saw the same place at different times.

The graph's own uncertainty limits where to look. A match counts only if neither side saw through what the other saw
there, and, if the search was wide, only together with another match that agrees (Mangelson et al. 2018).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from services.mapper.slam.pose_graph import Link, Uncertainty
from services.mapper.slam.registration import Surface, register
from services.mapper.slam.search import search
from services.mapper.slam.segments import Segment, agreement, submap

MAX_DISTANCE_M = 6.0  # between the references of segments that are matched
MIN_APART = 3  # segments between two that are matched
MAX_TARGETS = 2  # for each segment in one round
SIGMAS = 3.0  # standard deviations of the graph within which to look
DIRECT = np.array([0.3, 0.3, 0.1])  # m, m, rad: a smaller window needs no search
MIN_MATCHED, MIN_SHARE = 60, 0.85  # elements, and their share among those that match or contradict
AMBIGUOUS = 0.8  # as many matched elements elsewhere, relative to the best, mean that the place is not unique
MAX_SQUARED_DEVIATION = 16.3  # chi squared with three degrees of freedom, 0.1 %
# Standard deviations of a match beyond its noise: the segment is not quite rigid.
MATCH = np.array([0.01, 0.01, 0.003])


@dataclass(frozen=True)
class Closure:
    """A match of one segment with another."""

    first: int  # segment
    second: int
    link: Link
    wide: bool  # found by a wide search


def find_closures(
    segments: Sequence[Segment],
    poses: Array,
    uncertainty: Uncertainty,
    known: set[tuple[int, int]],
    window: float,
    report: Callable[[float], None] = lambda _done: None,
) -> list[Closure]:
    """Closures between pairs of segments whose position relative to one another is known to within ``window`` m.

    ``poses`` (N, 3) are of the key scans, ``uncertainty`` that of the segments' references, ``known`` the pairs
    already tried.
    """
    found, places = [], poses[[segment.reference for segment in segments]]
    for second in range(len(segments)):
        report(second / len(segments))
        for first in _targets(second, places, uncertainty, window, known):
            known.add((first, second))
            closure = _match(segments, first, second, poses, uncertainty)
            if closure is not None:
                found.append(closure)
    return _consistent(found, poses, uncertainty)


def _targets(
    second: int, places: Array, uncertainty: Uncertainty, window: float, known: set[tuple[int, int]]
) -> list[int]:
    """Earlier segments near ``second``, nearest first, apart from one another."""
    distance = np.hypot(*(places[: max(0, second - MIN_APART), :2] - places[second, :2]).T)
    chosen: list[int] = []
    for first in np.argsort(distance):
        if distance[first] > MAX_DISTANCE_M + window or len(chosen) == MAX_TARGETS:
            break
        if (int(first), second) in known or not uncertainty.linked(int(first), second):
            continue
        if any(abs(first - other) < MIN_APART for other in chosen):
            continue
        deviation = SIGMAS * float(np.sqrt(np.linalg.eigvalsh(uncertainty.of_pair(int(first), second)[:2, :2])[1]))
        if deviation < window and distance[first] < MAX_DISTANCE_M + deviation:
            chosen.append(int(first))
    return chosen


def _match(
    segments: Sequence[Segment], first: int, second: int, poses: Array, uncertainty: Uncertainty
) -> Closure | None:
    target, moved = submap(segments, first, poses), segments[second]
    predicted = se2.between(poses[target.reference], poses[moved.reference])
    covariance = uncertainty.of_pair(first, second)
    window = SIGMAS * np.sqrt(np.diag(covariance))
    wide = bool((window > DIRECT).any())
    surface = Surface(target.elements)
    starts = search(surface.elements, moved.elements, predicted, window) if wide else predicted[None]
    matches = []
    for start in starts:
        found = register(surface, moved.elements, start)
        if found is None:
            continue
        matched, both, against = agreement(target, surface, moved, found.pose)
        share = both / max(1, both + against)
        link_covariance = np.linalg.inv(found.information + np.eye(3)) + np.diag(MATCH**2)
        off = found.pose - predicted
        off[2] = se2.wrap(off[2])
        if off @ np.linalg.solve(covariance + link_covariance, off) < MAX_SQUARED_DEVIATION:
            matches.append((matched * share, matched, share, found.pose, link_covariance))
    if not matches:
        return None
    matches.sort(key=lambda each: -each[0])
    score, matched, share, pose, link_covariance = matches[0]
    if matched < MIN_MATCHED or share < MIN_SHARE:
        return None
    for other, _, _, elsewhere, _ in matches[1:]:
        off = elsewhere - pose
        if other > AMBIGUOUS * score and (np.hypot(off[0], off[1]) > 0.3 or abs(se2.wrap(off[2])) > 0.15):
            return None
    link = Link(target.reference, moved.reference, pose, np.linalg.inv(link_covariance), robust=True)
    return Closure(first, second, link, wide)


def _consistent(closures: list[Closure], poses: Array, uncertainty: Uncertainty) -> list[Closure]:
    """The closures that agree with one another: narrow ones, and wide ones that another one supports."""
    return [
        closure
        for closure in closures
        if not closure.wide
        or any(_support(closure, other, poses, uncertainty) for other in closures if other is not closure)
    ]


def _support(a: Closure, b: Closure, poses: Array, uncertainty: Uncertainty) -> bool:
    """Whether two closures confirm one another: the circle through both of them closes, and could have failed to."""
    if not (uncertainty.linked(a.first, b.first) and uncertainty.linked(a.second, b.second)):
        return False
    there = uncertainty.of_pair(a.first, b.first)
    back = uncertainty.of_pair(a.second, b.second)
    covariance = there + back + np.linalg.inv(a.link.information) + np.linalg.inv(b.link.information)
    if (np.sqrt(np.diag(covariance)) > 2 * DIRECT).any():
        return False
    way = se2.between(poses[a.link.first], poses[b.link.first])
    other_way = se2.between(poses[a.link.second], poses[b.link.second])
    off = se2.between(se2.compose(a.link.pose, other_way), se2.compose(way, b.link.pose))
    turned = _at(a, b, poses)
    return bool(off @ np.linalg.solve(turned + covariance, off) < MAX_SQUARED_DEVIATION)


def _at(a: Closure, b: Closure, poses: Array) -> Array:
    """Covariance (3, 3) that headings add over the distances in a circle through two closures."""
    reach = max(
        float(np.hypot(*se2.between(poses[i], poses[j])[:2]))
        for i, j in ((a.link.first, b.link.first), (a.link.second, b.link.second))
    )
    turn = float(np.linalg.inv(a.link.information)[2, 2] + np.linalg.inv(b.link.information)[2, 2])
    return np.diag([turn * reach**2, turn * reach**2, 0.0])
