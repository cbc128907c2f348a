"""Builds a trajectory from a drive: front end, loop closures, joint refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from services.mapper.slam.back_end import BackEnd
from services.mapper.slam.drive import RawDrive
from services.mapper.slam.front_end import TrackedDrive, track_drive
from services.mapper.slam.loop_closure import LoopClosure

# The `window` of each round of loop closing: first only pairs of submaps whose relative position is well known, because
# their closures make it better known for other pairs. Each window is used twice, because a round tries only few pairs
# with each submap. The last rounds try those that became well known only after the wide windows.
WINDOWS_M = (1.0, 1.0, 3.0, 3.0, 10.0, 10.0, 30.0, 30.0, 1.0, 1.0)


@dataclass(frozen=True)
class DriveTrajectory:
    """Poses of all scans of a drive."""

    poses: Array  # (N, 3) base_link in map; NaN where it is unknown
    keys: list[int]  # numbers of the key scans
    closures: list[LoopClosure]
    unmatched: int  # scans that did not match the ones before


def build_trajectory(drive: RawDrive, report: Callable[[str, float], None] = lambda _t, _d: None) -> DriveTrajectory:
    """Finds the poses at which all scans of a drive agree best."""
    tracked = track_drive(drive, lambda done: report("tracking", done))
    back_end = BackEnd(drive.laser)
    back_end.extend(tracked.key_scans)
    searching = True
    while searching:
        for number, window in enumerate(WINDOWS_M):

            def report_round(done: float, before: int = number) -> None:
                report("closing loops", (before + done) / len(WINDOWS_M))

            back_end.close_loops(tracked.key_scans, window, report_round)
        searching = back_end.join_pieces(tracked.key_scans)
    in_map = back_end.in_map(tracked.key_scans)
    poses = np.where(in_map[:, None], back_end.poses, np.nan)
    keys = [key for key, known in zip(tracked.keys, in_map, strict=True) if known]
    return DriveTrajectory(poses_of_all_scans(tracked, poses), keys, back_end.closures, tracked.unmatched)


def poses_of_all_scans(tracked: TrackedDrive, poses: Array) -> Array:
    """Poses (N, 3) of all scans, from the corrected ``poses`` (K, 3) of the key scans.

    Scans of no piece, and of pieces whose key scans have no pose, get NaN.
    """
    keys, pieces = np.array(tracked.keys), tracked.key_scans.pieces
    before = np.searchsorted(keys, np.arange(len(tracked.poses)), side="right") - 1
    in_piece = tracked.pieces == pieces[np.maximum(before, 0)]
    return np.where(in_piece[:, None], distribute_corrections(tracked.poses, keys, poses, pieces), np.nan)


def distribute_corrections(
    poses: Array, keys: npt.NDArray[np.int_], corrected: Array, pieces: npt.NDArray[np.int_]
) -> Array:
    """Poses (N, 3) of all scans, after those of the key scans, numbers ``keys`` (K,), were ``corrected`` (K, 3).

    Between two key scans of one of the ``pieces`` (K,), the correction changes from that of the first to that of the
    second.
    """
    number = np.arange(len(poses))
    before = np.clip(np.searchsorted(keys, number, side="right") - 1, 0, len(keys) - 1)
    after = np.minimum(before + 1, len(keys) - 1)
    after = np.where(pieces[after] == pieces[before], after, before)
    sides = [se2.compose(corrected[k], se2.between(poses[keys[k]], poses)) for k in (before, after)]
    share = (number - keys[before]) / np.maximum(keys[after] - keys[before], 1)
    result = sides[0] + share[:, None] * se2.difference(sides[1], sides[0])
    result[:, 2] = se2.wrap(result[:, 2])
    return np.asarray(result)
