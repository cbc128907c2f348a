"""Reads all scans of a log or recording into memory."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt
from rich.console import Console

from common.errors import UserError
from common.geometry.se2 import Array
from common.messages.definitions import CmdVel, Goal, Odom, Scan, Truth
from common.messages.topics import CMD_VEL, GOAL, ODOM, SCAN, TRUTH
from common.robot.ranges import is_surface, ranges_for_localisation
from presage.laser_scan import LaserScan
from presage.logs.log import Log, Reading, check_ranges
from presage.logs.opening import kind_of, open_log
from presage.recordings.recorded_session import StampedRows
from presage.recordings.selection import entries, robot_of
from services.estimator.factory import ScannerGeometry
from services.recorder.reader import Recording, read_recording

RECORDED_TRUTH = "the recorded truth"
# The longest range of a log probably means "no return" if it is at least this share of all beams, occurs in this share
# of the directions, and is so many times more frequent than any other range of at least half of it.
NO_RETURN_SHARE, NO_RETURN_DIRECTIONS, NO_RETURN_RATIO = 0.01, 0.5, 5
Prior = Literal["motion", "odometry", "command"]


@dataclass(frozen=True)
class Scans:
    """N scans of B beams from one scanner; ``scans[k]``, and iteration, give them as LaserScan."""

    geometry: ScannerGeometry
    ranges: Array  # (N, B) m; +inf for no return, -inf for not measured
    stamps: Array | None = None  # (N,) s
    odom: Array | None = None  # (N, 3) base_link in odom; NaN where unknown
    initial_pose: Array | None = None  # (3,) in map
    truth: Array | None = None  # (N, 3) base_link in map; NaN where unknown
    world: str | None = None  # name of the recorded world
    truth_is: str = RECORDED_TRUTH  # source of `truth`: the recorded truth, or the reference of a log
    notes: tuple[str, ...] = ()  # assumptions, and what was left out
    commands: Array | None = None  # (N, 3) the last velocity command before each scan; NaN where there is none
    goals: Array | None = None  # (N, 3) the goal at each scan; NaN where there is none
    stamps_ns: npt.NDArray[np.int64] | None = None  # (N,) of a recording
    time_increment: float = 0.0  # s between beams, as in a scan message

    def __len__(self) -> int:
        return len(self.ranges)

    @overload
    def __getitem__(self, k: int) -> LaserScan: ...

    @overload
    def __getitem__(self, k: slice) -> list[LaserScan]: ...

    def __getitem__(self, k: int | slice) -> LaserScan | list[LaserScan]:
        return [self._scan(each) for each in range(len(self))[k]] if isinstance(k, slice) else self._scan(k)

    def _scan(self, k: int) -> LaserScan:
        def row(values: Array | None) -> Array | None:
            return None if values is None else values[k]

        stamp = None if self.stamps is None else float(self.stamps[k])
        if self.stamps_ns is not None:
            stamp = float(self.stamps_ns[k] * 1e-9)  # the estimator service's arithmetic, so that beliefs are equal
        geometry = self.geometry
        return LaserScan(
            self.ranges[k],
            geometry.angles,
            geometry.range_max,
            stamp,
            row(self.odom),
            row(self.commands),
            row(self.goals),
            geometry.mount,
            geometry.sigma,
            geometry.sigma_relative,
            geometry.mount_assumed,
            row(self.truth),
            time_increment=self.time_increment,
        )

    def __iter__(self) -> Iterator[LaserScan]:
        return (self[k] for k in range(len(self)))

    def with_prior(self, prior: Prior) -> Scans:
        """The scans with only this source of the motion between them; "motion" is the scans alone."""
        return replace(
            self,
            odom=self.odom if prior == "odometry" else None,
            commands=self.commands if prior == "command" else None,
        )

    def print_notes(self, console: Console) -> None:
        """Prints the notes, one line each."""
        for note in self.notes:
            console.print(note, highlight=False, soft_wrap=True)

    def part(self, numbers: npt.NDArray[np.intp]) -> Scans:
        """Selects the scans with the given indices (K,), ascending.

        The initial pose belongs to the first scan and is dropped if that is not selected.
        """

        def of(values: npt.NDArray[Any] | None) -> Any:
            return None if values is None else values[numbers]

        return replace(
            self,
            ranges=self.ranges[numbers],
            stamps=of(self.stamps),
            odom=of(self.odom),
            truth=of(self.truth),
            commands=of(self.commands),
            goals=of(self.goals),
            stamps_ns=of(self.stamps_ns),
            initial_pose=self.initial_pose if numbers[0] == 0 else None,
        )


def read_scans(path: str | Path, mount: Array | None = None, reading: Reading | None = None) -> Scans:
    """Reads all scans of a recording, an .npz file, a CARMEN log or a ROS bag; raises UserError if that fails.

    ``mount`` (3,) is the laser in base_link; it replaces the mount of a log and is ignored for a recording. The poses
    in an .npz file (odom, initial_pose, reference) are those of base_link; with a mount of zero they are those of the
    laser. `Scans.truth` is the truth of a recording or the reference of a log. ``reading`` has further options for
    logs.
    """
    path, reading = Path(path), reading or Reading()
    if kind_of(path) == "recording":
        if not reading.is_default:
            raise UserError(
                f"{path}: a recording contains the description of its scanner: leave out the options for logs"
            )
        return _read_recording(path)
    return scans_of_log(open_log(path, reading if mount is None else replace(reading, mount=mount)))


def seconds(stamps_ns: list[int]) -> Array:
    """Stamps (N,) in s; division of integers gives the nearest float, unlike a multiplication by 1e-9."""
    return np.array([stamp / 1_000_000_000 for stamp in stamps_ns])


def scans_of_log(log: Log) -> Scans:
    """Reads all scans of a log; raises UserError if none is usable."""
    unknown = np.full(3, np.nan)
    ranges, stamps, odoms, references = [], [], [], []
    for logged in log.valid_scans():
        ranges.append(ranges_for_localisation(logged.ranges))
        stamps.append(logged.stamp_ns)
        odoms.append(unknown if logged.odom is None else logged.odom)
        references.append(unknown if logged.reference is None else logged.reference)
    left_out = log.describe_left_out()
    if not ranges:
        raise UserError(f"{log.path}: no usable scan in it" + (f"; left out: {left_out}" if left_out else ""))
    times = [stamp for stamp in stamps if stamp is not None]
    all_ranges = np.array(ranges)
    no_return = _describe_probable_no_return(all_ranges)
    return Scans(
        ScannerGeometry(log.angles, log.mount, log.range_max, mount_assumed=log.mount_assumed),
        all_ranges,
        seconds(times) if len(times) == len(ranges) else None,
        np.array(odoms) if log.odometry else None,
        log.initial_pose,
        np.array(references) if log.reference else None,
        truth_is=log.reference or RECORDED_TRUTH,
        time_increment=log.time_increment,
        notes=(*log.notes, *([no_return] if no_return else []), *([f"left out: {left_out}"] if left_out else [])),
    )


def _describe_probable_no_return(ranges: Array) -> str:
    """A note if the longest of the ranges (N, B) m probably means "no return"; empty otherwise.

    Some scanners report a fixed value shorter than the stated maximum range. Such beams look like a wall that moves
    with the robot. As ranges are rounded in many logs, the longest one is compared with others, and as a robot may
    stand, directions are counted.
    """
    single = ranges.astype(np.float32)
    longest = np.max(single, where=is_surface(single), initial=0.0)
    at_longest = single == longest
    share = float(at_longest.mean())
    if longest == 0 or share < NO_RETURN_SHARE or at_longest.any(axis=0).mean() < NO_RETURN_DIRECTIONS:
        return ""
    _, counts = np.unique(single[(single >= longest / 2) & (single < longest)], return_counts=True)
    if at_longest.sum() < NO_RETURN_RATIO * counts.max(initial=1):
        return ""
    return (
        f"{share:.0%} of all ranges are exactly {longest} m, and none is longer: if this means no return, "
        f"set range_max to {longest} in section log of --config"
    )


def mount_assumed(recording: Recording) -> bool:
    """Whether the recording was imported from a log that does not state the mount of the laser."""
    return recording.metadata.get("log", {}).get("mount_assumed") == "true"


def _read_recording(path: Path) -> Scans:
    recording = read_recording(path)
    world = recording.world()
    scans: list[Scan] = []
    logged_ns: list[int] = []  # of each scan
    odoms, truths = StampedRows(), StampedRows()
    commands, goals = [], []  # of each scan
    command = goal = unknown = np.full(3, np.nan)
    for _, message, raw in entries(recording, robot_of(recording), SCAN, ODOM, TRUTH, CMD_VEL, GOAL):
        if isinstance(message, Scan) and (not scans or message.stamp_ns != scans[-1].stamp_ns):
            scans.append(message)
            logged_ns.append(raw.logged_ns)
            commands.append(command)
            goals.append(goal)
        elif isinstance(message, Odom):
            odoms.add(message.stamp_ns, raw.logged_ns, *message.pose.array())
        elif isinstance(message, Truth):
            truths.add(message.stamp_ns, raw.logged_ns, *message.pose.array())
        elif isinstance(message, CmdVel):
            command = message.twist.array()
        elif isinstance(message, Goal):
            pose = None if message.cancel or message.explore else message.pose_in_map(world)
            goal = unknown if pose is None else pose.array()
    if recording.warning:  # damage is only found while reading
        print(f"warning: {recording.warning}", file=sys.stderr)
    if not scans:
        raise UserError(f"{path}: no scan in it")
    first = scans[0]
    alike = [s for s in scans if len(s.ranges) == len(first.ranges) and s.mount == first.mount]
    if len(alike) != len(scans):
        raise UserError(f"{path}: the scanner changes during the recording; only one scanner per file is supported")
    stamps_ns = np.array([s.stamp_ns for s in scans], np.int64)
    ranges = np.array([ranges_for_localisation(s.ranges) for s in scans])
    check_ranges(path, ranges)
    return Scans(
        replace(ScannerGeometry.of_scan(first), mount_assumed=mount_assumed(recording)),
        ranges,
        seconds([s.stamp_ns for s in scans]),
        odoms.poses_at(stamps_ns, np.array(logged_ns)) if len(odoms) else None,
        None,
        truths.poses_at(stamps_ns, np.array(logged_ns)) if len(truths) else None,
        world.name if world is not None else None,
        recording.metadata.get("log", {}).get("reference") or RECORDED_TRUTH,
        commands=np.array(commands),
        goals=np.array(goals),
        stamps_ns=stamps_ns,
        time_increment=first.time_increment,
    )
