"""Submaps: a few successive key scans as one rigid group, which shows more of the surroundings than one scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from common.robot.ranges import is_surface
from common.robot.scan_geometry import Sweep
from services.mapper.slam.elements import Elements, concatenate
from services.mapper.slam.registration import MATCHED_M, Surface

KEY_SCANS_PER_SUBMAP = 8  # successive ones that form a submap
PERSON_M, GAP_M = 0.7, 0.3  # size of a person, the largest moving object, and largest gap between its parts
PASSED_M = 0.3  # behind an element, along its normal, from where a beam counts as having passed through it


@dataclass(frozen=True)
class PosedScans:
    """Scans that were taken from known poses."""

    poses: Array  # (S, 3) of the laser
    ranges: Array  # (S, B) m
    angles: Array  # (B,) rad

    def see_through(self, elements: Elements) -> npt.NDArray[np.bool_]:
        """Mask (K,) of elements in places through which some scan saw."""
        through = np.zeros(len(elements), np.bool_)
        sweep = Sweep.of_angles(self.angles)
        for pose, ranges in zip(self.poses, self.ranges, strict=True):
            local = elements.transformed(se2.inverse(pose))
            x, y = local.points.T
            beam, distance = sweep.beams_at(np.arctan2(y, x)), np.hypot(x, y)
            inside = (beam > 0) & (beam < len(ranges) - 1)
            around = np.where(inside, beam, 1)[:, None] + np.arange(-1, 2)
            nearest = np.where(is_surface(ranges), ranges, 0.0)[around].min(axis=1)  # without return: no evidence
            depth = np.abs(np.einsum("ki,ki->k", local.normals, local.points)) * (nearest / distance - 1)
            through |= inside & (depth > PASSED_M)
        return through


@dataclass(frozen=True)
class Submap:
    """Successive key scans, in the frame of the one in their middle, the reference."""

    reference: int  # number of the key scan
    piece: int  # of the drive
    elements: Elements
    scans: PosedScans  # the same key scans


def divide_into_submaps(
    poses: Array,
    pieces: npt.NDArray[np.int_],
    elements: Sequence[Elements],
    ranges: Array,
    angles: Array,
    mount: Array,
    *,
    growing: bool,
) -> list[Submap]:
    """Divides key scans at ``poses`` (N, 3) of ``pieces`` (N,), with ``ranges`` (N, B), into submaps.

    If the drive is still ``growing``, its last submap is left out until it is complete.
    """
    found, ends = [], np.append(np.flatnonzero(np.diff(pieces)) + 1, len(pieces))
    first = 0
    while first < len(poses):
        end = min(first + KEY_SCANS_PER_SUBMAP, int(ends[np.searchsorted(ends, first, side="right")]))
        if growing and end == len(poses) and end < first + KEY_SCANS_PER_SUBMAP:
            break
        keys = np.arange(first, end)
        reference = int(keys[len(keys) // 2])
        local = se2.between(poses[reference], poses[keys])
        placed = concatenate([elements[key].transformed(pose) for key, pose in zip(keys.tolist(), local, strict=True)])
        scans = PosedScans(se2.compose(local, mount), ranges[keys], angles)
        found.append(Submap(reference, int(pieces[first]), placed, scans))
        first = end
    return found


def merge_with_neighbours(submaps: Sequence[Submap], middle: int, poses: Array) -> Submap:
    """Merges a submap with its neighbours in time, in its frame; ``poses`` (N, 3) are of all key scans."""
    reference, piece = submaps[middle].reference, submaps[middle].piece
    around = [each for each in submaps[max(0, middle - 1) : middle + 2] if each.piece == piece]
    offsets = [se2.between(poses[reference], poses[each.reference]) for each in around]
    scans = PosedScans(
        np.concatenate([se2.compose(off, each.scans.poses) for off, each in zip(offsets, around, strict=True)]),
        np.concatenate([each.scans.ranges for each in around]),
        around[0].scans.angles,
    )
    placed = [each.elements.transformed(off) for off, each in zip(offsets, around, strict=True)]
    return Submap(reference, piece, concatenate(placed), scans)


@dataclass(frozen=True)
class Agreement:
    """How well two submaps agree, in numbers of elements. Elements outside the other submap's view do not count."""

    matched: int  # elements of the second submap that match
    agreeing: int  # elements of both that match
    contradicting: int  # elements of both, of objects larger than a person, through which the other one saw

    @property
    def agreeing_fraction(self) -> float:
        """Fraction of the elements that agree, among those that agree or contradict."""
        return self.agreeing / max(1, self.agreeing + self.contradicting)


def compare_submaps(first: Submap, surface: Surface, second: Submap, pose: Array) -> Agreement:
    """Compares two submaps, the second at ``pose`` (3,) in the first; ``surface`` has the elements of the first."""
    placed = second.elements.transformed(pose)
    second_matches = surface.correspondence_distances(placed) < MATCHED_M
    first_matches = Surface(placed).correspondence_distances(first.elements) < MATCHED_M
    first_in_second = first.elements.transformed(se2.inverse(pose))
    contradicting = _count_contradicting(first.scans, placed.part(~second_matches))
    contradicting += _count_contradicting(second.scans, first_in_second.part(~first_matches))
    matched = int(second_matches.sum())
    return Agreement(matched, matched + int(first_matches.sum()), contradicting)


def _count_contradicting(scans: PosedScans, elements: Elements) -> int:
    """Number of elements through which scans saw, and that form connected lines longer than a person is wide."""
    points = elements.points[scans.see_through(elements)]
    if len(points) == 0:
        return 0
    group = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(points, axis=0).T) > GAP_M)])
    first = points[np.searchsorted(group, group)]
    extent = np.zeros(group[-1] + 1)
    np.maximum.at(extent, group, np.hypot(*(points - first).T))
    return int((extent[group] > PERSON_M).sum())
