"""Finds where a piece of the drive lies in the map, if nothing is known of its place: the robot was carried off.

Segments of the piece are searched for in the whole map. Places that look alike are told apart by the rest of the piece:
it is joined only if two of its segments agree on its place, no segment contradicts it, and no other place is as good.
If a later segment contradicts it, the piece is separated again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from services.mapper.slam.loop_closure import AMBIGUOUS, MATCH, MAX_DISTANCE_M, MIN_MATCHED, MIN_SHARE, Closure
from services.mapper.slam.pose_graph import Link
from services.mapper.slam.registration import Surface, register
from services.mapper.slam.search import search
from services.mapper.slam.segments import Segment, agreement, submap

TARGET_SPACING_M = 2.0  # between segments of the map in which a segment is searched for
REACH_M, TURN_STEP = 4.0, 0.06  # m from them, and rad between the headings tried
SAME_M, SAME_TURN = 0.5, 0.1  # two matches whose places for a segment differ by less agree
MIN_SUPPORT = 2  # segments that agree
# Share of contradictions with the nearest segments of the map that refutes a place, beyond those that people cause.
MAX_CONTRADICTION, NEAREST = 0.05, 3


@dataclass(frozen=True)
class Match:
    """A place in the map where a segment of a piece may be."""

    closure: Closure
    score: float


class Joining:
    """Collects matches between segments of the map and segments of other pieces; each pair is searched once."""

    def __init__(self) -> None:
        self._known: set[tuple[int, int]] = set()
        self._matches: list[Match] = []

    def find(self, segments: Sequence[Segment], poses: Array, component: npt.NDArray[np.int_]) -> list[Closure]:
        """The closures that join a piece with the map, or nothing.

        ``poses`` (N, 3) are of the key scans; those of one ``component`` (N,) are linked. The largest one is the map.
        """
        of_segment = component[[segment.reference for segment in segments]]
        in_map = of_segment == largest(component)
        targets = _apart(segments, poses, np.flatnonzero(in_map))
        for second in np.flatnonzero(~in_map).tolist():
            for first in targets:
                if (first, second) not in self._known:
                    self._known.add((first, second))
                    self._matches += _match(segments, first, second, poses)
            rest = [each for each in self._matches if in_map[each.closure.first]]
            rest = [each for each in rest if of_segment[each.closure.second] == of_segment[second]]
            if found := _agreeing(rest, segments, poses):
                # Once only: if this join is taken back, the same matches must not lead to it again.
                self._matches = [each for each in self._matches if all(each.closure is not used for used in found)]
                return found
        return []


def largest(component: npt.NDArray[np.int_]) -> int:
    """The label of the component (N,) with most poses."""
    return int(np.argmax(np.bincount(component)))


def _apart(segments: Sequence[Segment], poses: Array, numbers: npt.NDArray[np.int_]) -> list[int]:
    """Segments at places that are `TARGET_SPACING_M` apart."""
    chosen: list[int] = []
    for number in numbers.tolist():
        place = poses[segments[number].reference, :2]
        if all(np.hypot(*(poses[segments[other].reference, :2] - place)) > TARGET_SPACING_M for other in chosen):
            chosen.append(number)
    return chosen


def _match(segments: Sequence[Segment], first: int, second: int, poses: Array) -> list[Match]:
    """The places near segment ``first`` where segment ``second`` may be."""
    target, moved = submap(segments, first, poses), segments[second]
    surface = Surface(target.elements)
    found = []
    window = np.array([REACH_M, REACH_M, np.pi])
    for start in search(surface.elements, moved.elements, np.zeros(3), window, TURN_STEP):
        registered = register(surface, moved.elements, start)
        if registered is None:
            continue
        matched, both, against = agreement(target, surface, moved, registered.pose)
        share = both / max(1, both + against)
        if matched >= MIN_MATCHED and share >= MIN_SHARE:
            covariance = np.linalg.inv(registered.information + np.eye(3)) + np.diag(MATCH**2)
            link = Link(target.reference, moved.reference, registered.pose, np.linalg.inv(covariance), robust=True)
            found.append(Match(Closure(first, second, link, wide=True), matched * share))
    return found


def _agreeing(matches: Sequence[Match], segments: Sequence[Segment], poses: Array) -> list[Closure]:
    """The matches of one piece that agree on its place, if no other place is as good."""
    if not matches:
        return []
    places = np.array([_place(each.closure.link, poses) for each in matches])
    references = poses[[segments[each.closure.second].reference for each in matches]]
    agree = []  # (M, M)
    for place in places:
        off = se2.between(se2.compose(place, references), se2.compose(places, references))
        agree.append((np.hypot(off[:, 0], off[:, 1]) < SAME_M) & (np.abs(off[:, 2]) < SAME_TURN))
    groups = [[each for each, same in zip(matches, row, strict=True) if same] for row in agree]
    votes = [_votes(group) for group in groups]
    totals = np.array([sum(each.values()) for each in votes])
    possible = np.ones(len(matches), np.bool_)
    while possible.any():
        best = int(np.argmax(np.where(possible, totals, 0.0)))
        if len(votes[best]) < MIN_SUPPORT:
            return []
        if not _is_place_contradicted(places[best], matches[best], segments, poses):
            others = totals[possible & ~agree[best]].max(initial=0.0)
            return [] if others > AMBIGUOUS * totals[best] else [each.closure for each in groups[best]]
        possible &= ~agree[best]
    return []


def _votes(matches: Sequence[Match]) -> dict[int, float]:
    """The score of the best match of each segment of a piece."""
    best: dict[int, float] = {}
    for match in matches:
        best[match.closure.second] = max(best.get(match.closure.second, 0.0), match.score)
    return best


def _place(link: Link, poses: Array) -> Array:
    """The frame (3,) of the piece in that of the map, according to a link."""
    return np.asarray(se2.compose(se2.compose(poses[link.first], link.pose), se2.inverse(poses[link.second])))


def _is_place_contradicted(place: Array, match: Match, segments: Sequence[Segment], poses: Array) -> bool:
    """Whether some segment of the piece contradicts the map, if the frame of the piece is at ``place`` (3,)."""
    piece = segments[match.closure.second].piece
    targets = [k for k, each in enumerate(segments) if each.piece == segments[match.closure.first].piece]
    return any(
        is_contradicted(number, se2.compose(place, poses[each.reference]), targets, segments, poses)
        for number, each in enumerate(segments)
        if each.piece == piece
    )


def is_contradicted(
    number: int, pose: Array, targets: Sequence[int], segments: Sequence[Segment], poses: Array
) -> bool:
    """Whether a segment at a pose (3,) contradicts the segments ``targets``, more than its own piece contradicts it."""
    moved = segments[number]
    own = [k for k in (number - 1, number + 1) if 0 <= k < len(segments) and segments[k].piece == moved.piece]
    usual = _contradiction(moved, poses[moved.reference], own, segments, poses)
    return _contradiction(moved, pose, targets, segments, poses) > MAX_CONTRADICTION + 2 * usual


def _contradiction(
    moved: Segment, pose: Array, targets: Sequence[int], segments: Sequence[Segment], poses: Array
) -> float:
    """Share of contradictions between a segment at a pose (3,) and the nearest of other segments."""
    references = np.array([segments[k].reference for k in targets], int)
    distance = np.hypot(*(poses[references, :2] - pose[:2]).T)
    counts = np.zeros(2)
    for k in np.argsort(distance)[:NEAREST]:
        if distance[k] < MAX_DISTANCE_M:
            target = segments[targets[k]]
            local = se2.between(poses[target.reference], pose)
            counts += agreement(target, Surface(target.elements), moved, local)[1:]
    return float(counts[1] / max(MIN_MATCHED, counts.sum()))
