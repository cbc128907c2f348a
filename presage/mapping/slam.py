"""Builds a trajectory from a drive: front end, loop closures, joint refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from presage.mapping.drive import RawDrive
from presage.mapping.front_end import Track, track
from presage.mapping.loop_closure import MAX_SQUARED_DEVIATION, Closure, find_closures
from presage.mapping.pose_graph import LinkTable, optimise
from presage.mapping.segments import segments_of

WINDOWS_M = (1.0, 1.0, 3.0, 3.0, 10.0, 10.0, 1.0, 1.0)  # of the rounds of loop closing


@dataclass(frozen=True)
class Trajectory:
    """Poses of all scans of a drive."""

    poses: Array  # (N, 3) base_link in map
    keys: list[int]  # key scans
    closures: list[Closure]
    lost: int  # scans that did not match the ones before


def build_trajectory(drive: RawDrive, report: Callable[[str, float], None] = lambda _t, _d: None) -> Trajectory:
    """The poses from which all scans of a drive agree best."""
    tracked = track(drive, lambda done: report("tracking", done))
    keys = np.array(tracked.keys)
    poses = tracked.poses[keys]
    closures: list[Closure] = []
    known: set[tuple[int, int]] = set()
    for number, window in enumerate(WINDOWS_M):
        segments = segments_of(poses, tracked.elements, drive.ranges[keys], drive.angles, drive.mount)
        links = [*tracked.links, *(each.link for each in closures)]

        def report_round(done: float, before: int = number) -> None:
            report("closing loops", (before + done) / len(WINDOWS_M))

        found = find_closures(segments, poses, links, known, window, report_round)
        closures = closures + found
        poses = optimise(poses, [*tracked.links, *(each.link for each in closures)])
        closures = _plausible(closures, poses)
        poses = optimise(poses, [*tracked.links, *(each.link for each in closures)])
    return Trajectory(spread(tracked, poses), tracked.keys, closures, tracked.lost)


def _plausible(closures: list[Closure], poses: Array) -> list[Closure]:
    """Without the closures that contradict the graph."""
    deviation = LinkTable([each.link for each in closures]).squared_deviations(poses)
    return [each for each, off in zip(closures, deviation, strict=True) if off < MAX_SQUARED_DEVIATION]


def spread(tracked: Track, poses: Array) -> Array:
    """Poses (N, 3) of all scans, from the corrected ``poses`` (K, 3) of the key scans.

    Between two key scans, the correction changes from that of the first to that of the second.
    """
    keys = np.array(tracked.keys)
    number = np.arange(len(tracked.poses))
    before = np.clip(np.searchsorted(keys, number, side="right") - 1, 0, len(keys) - 1)
    after = np.minimum(before + 1, len(keys) - 1)
    sides = [se2.compose(poses[k], se2.between(tracked.poses[keys[k]], tracked.poses)) for k in (before, after)]
    share = (number - keys[before]) / np.maximum(keys[after] - keys[before], 1)
    off = sides[1] - sides[0]
    off[:, 2] = se2.wrap(off[:, 2])
    result = sides[0] + share[:, None] * off
    result[:, 2] = se2.wrap(result[:, 2])
    return np.asarray(result)
