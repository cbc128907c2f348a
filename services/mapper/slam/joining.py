"""Finds the pose of a piece of the drive in the map, after the robot was kidnapped.

Submaps of the piece are searched for in the whole map. The rest of the piece distinguishes places that look alike: it
is joined only if two of its submaps agree on its pose, no submap contradicts it, and no other pose is as good. If a
later submap contradicts it, the piece is separated again.

Pieces that links connect form a component of the pose graph, and are joined together. The largest component is the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from services.mapper.slam.correlative_search import correlative_search
from services.mapper.slam.loop_closure import MAX_DISTANCE_M, MIN_MATCHED, RIVAL_SHARE, LoopClosure, match_submaps
from services.mapper.slam.pose_graph import PoseLink
from services.mapper.slam.registration import Surface
from services.mapper.slam.submaps import Submap, compare_submaps, merge_with_neighbours

TARGET_SPACING_M = 2.0  # between submaps of the map in which a submap is searched for
JOIN_WINDOW_M, TURN_STEP = 4.0, 0.06  # m to either side of a target, and rad between the headings that are tried
AGREEING_M, AGREEING_RAD = 0.5, 0.1  # two candidates agree if they place the piece this close together
MIN_SUPPORT = 2  # number of submaps that must agree
# A pose of a piece is rejected if the share of elements that contradict the nearest submaps exceeds this limit plus
# twice the share that is usual between successive submaps.
MAX_EXTRA_CONTRADICTION = 0.03
NEAREST_SUBMAPS = 3  # submaps of the map with which a submap of a piece is compared


@dataclass(frozen=True)
class JoinCandidate:
    """A closure that would join a piece with the map."""

    closure: LoopClosure
    score: float


class PieceJoiner:
    """Joins pieces with the map; searches each pair of submaps once, and keeps the candidates."""

    def __init__(self) -> None:
        self._searched: set[tuple[int, int]] = set()
        self._candidates: list[JoinCandidate] = []

    def find(self, submaps: Sequence[Submap], poses: Array, component: npt.NDArray[np.int_]) -> list[LoopClosure]:
        """Returns the loop closures that join a piece with the map, or an empty list.

        ``poses`` (N, 3) are of the key scans; those of one ``component`` (N,) are linked. The largest one is the map.
        """
        of_submap = component[[submap.reference for submap in submaps]]
        in_map = of_submap == largest_component(component)
        targets = _spaced_out(submaps, poses, np.flatnonzero(in_map))
        for second in np.flatnonzero(~in_map).tolist():
            in_component = of_submap == of_submap[second]
            if np.count_nonzero(in_component) < MIN_SUPPORT:
                continue
            for first in targets:
                if (first, second) not in self._searched:
                    self._searched.add((first, second))
                    self._candidates += _search_submap(submaps, first, second, poses)
            candidates = [
                each for each in self._candidates if in_map[each.closure.first] and in_component[each.closure.second]
            ]
            components = np.flatnonzero(in_map).tolist(), np.flatnonzero(in_component).tolist()
            if found := _agreed_closures(candidates, components, submaps, poses):
                # Each candidate is used once: if this join is undone, the same candidates must not lead to it again.
                self._candidates = [
                    each for each in self._candidates if all(each.closure is not used for used in found)
                ]
                return found
        return []


def largest_component(component: npt.NDArray[np.int_]) -> int:
    """The label of the component (N,) with most poses."""
    return int(np.argmax(np.bincount(component)))


def _spaced_out(submaps: Sequence[Submap], poses: Array, numbers: npt.NDArray[np.int_]) -> list[int]:
    """Selects submaps at least `TARGET_SPACING_M` apart."""
    chosen: list[int] = []
    for number in numbers.tolist():
        place = poses[submaps[number].reference, :2]
        if all(np.hypot(*(poses[submaps[other].reference, :2] - place)) > TARGET_SPACING_M for other in chosen):
            chosen.append(number)
    return chosen


def _search_submap(submaps: Sequence[Submap], first: int, second: int, poses: Array) -> list[JoinCandidate]:
    """The places near submap ``first`` where submap ``second`` may be."""
    target, source = merge_with_neighbours(submaps, first, poses), submaps[second]
    surface = Surface(target.elements)
    window = np.array([JOIN_WINDOW_M, JOIN_WINDOW_M, np.pi])
    starts = correlative_search(surface.elements, source.elements, np.zeros(3), window, TURN_STEP)
    matches = [match_submaps(target, surface, source, start) for start in starts]
    references = target.reference, source.reference
    return [
        JoinCandidate(match.closure(first, second, references, wide=True), match.score)
        for match in matches
        if match is not None and match.is_good
    ]


def _agreed_closures(
    candidates: Sequence[JoinCandidate],
    components: tuple[list[int], list[int]],
    submaps: Sequence[Submap],
    poses: Array,
) -> list[LoopClosure]:
    """The loop closures that agree on the pose of a component in the map, if no other pose is as good.

    ``components`` are the numbers of the submaps of the map, and of the component to be joined.
    """
    if not candidates:
        return []
    frames = np.array([_frame_of_piece(each.closure.link, poses) for each in candidates])
    agree = _which_agree(frames, poses[[submaps[each.closure.second].reference for each in candidates]])
    groups = [[each for each, same in zip(candidates, row, strict=True) if same] for row in agree]
    scores = [_best_scores(group) for group in groups]
    totals = np.array([sum(each.values()) for each in scores])
    possible = np.ones(len(candidates), np.bool_)
    while possible.any():
        best = int(np.argmax(np.where(possible, totals, 0.0)))
        if len(scores[best]) < MIN_SUPPORT:
            return []
        if not _is_frame_contradicted(frames[best], components, submaps, poses):
            rival = totals[possible & ~agree[best]].max(initial=0.0)
            return [] if rival > RIVAL_SHARE * totals[best] else [each.closure for each in groups[best]]
        possible &= ~agree[best]
    return []


def _which_agree(frames: Array, references: Array) -> npt.NDArray[np.bool_]:
    """Which candidates (M, M) agree: the ``frames`` (M, 3) of both put the ``references`` (M, 3) close together."""
    agree = []
    for frame in frames:
        off = se2.between(se2.compose(frame, references), se2.compose(frames, references))
        agree.append((np.hypot(off[:, 0], off[:, 1]) < AGREEING_M) & (np.abs(off[:, 2]) < AGREEING_RAD))
    return np.array(agree)


def _best_scores(candidates: Sequence[JoinCandidate]) -> dict[int, float]:
    """The best score of each submap of a piece."""
    best: dict[int, float] = {}
    for each in candidates:
        best[each.closure.second] = max(best.get(each.closure.second, 0.0), each.score)
    return best


def _frame_of_piece(link: PoseLink, poses: Array) -> Array:
    """The frame (3,) of the piece in that of the map, according to a link."""
    return np.asarray(se2.compose(se2.compose(poses[link.first], link.pose), se2.inverse(poses[link.second])))


def _is_frame_contradicted(
    frame: Array, components: tuple[list[int], list[int]], submaps: Sequence[Submap], poses: Array
) -> bool:
    """Whether, with the frame of the second component at ``frame`` (3,), some submap of it contradicts the first."""
    targets, sources = components
    return any(
        is_contradicted(number, se2.compose(frame, poses[submaps[number].reference]), targets, submaps, poses)
        for number in sources
    )


def is_contradicted(number: int, pose: Array, targets: Sequence[int], submaps: Sequence[Submap], poses: Array) -> bool:
    """Whether a submap at a pose (3,) contradicts the submaps ``targets``.

    It does if there are more contradictions than between successive submaps, where moving objects cause them.
    """
    nearest = _nearest(pose, targets, submaps, poses)
    if not nearest:
        return False
    usual = max(_contradiction_among_successive(k, submaps, poses) for k in (number, *nearest))
    return _contradicting_share(submaps[number], pose, nearest, submaps, poses) > MAX_EXTRA_CONTRADICTION + 2 * usual


def _nearest(pose: Array, targets: Sequence[int], submaps: Sequence[Submap], poses: Array) -> list[int]:
    """Those of the submaps ``targets`` that are nearest to a pose (3,)."""
    distance = np.hypot(*(poses[[submaps[k].reference for k in targets], :2] - pose[:2]).T) if targets else np.zeros(0)
    return [targets[k] for k in np.argsort(distance)[:NEAREST_SUBMAPS] if distance[k] < MAX_DISTANCE_M]


def _contradiction_among_successive(number: int, submaps: Sequence[Submap], poses: Array) -> float:
    """Share of contradictions between a submap and those before and after it in its piece."""
    submap = submaps[number]
    around = [k for k in (number - 1, number + 1) if 0 <= k < len(submaps) and submaps[k].piece == submap.piece]
    return _contradicting_share(submap, poses[submap.reference], around, submaps, poses)


def _contradicting_share(
    source: Submap, pose: Array, others: Sequence[int], submaps: Sequence[Submap], poses: Array
) -> float:
    """Share of contradictions between a submap at a pose (3,) and others."""
    agreeing = contradicting = 0
    for target in (submaps[k] for k in others):
        found = compare_submaps(target, Surface(target.elements), source, se2.between(poses[target.reference], pose))
        agreeing, contradicting = agreeing + found.agreeing, contradicting + found.contradicting
    return contradicting / max(MIN_MATCHED, agreeing + contradicting)
