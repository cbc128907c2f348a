"""A log: scanner geometry, and scans with odometry and reference poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from common.errors import UserError
from common.geometry.se2 import Array
from common.limits import MAX_RANGE_M

Clock = Literal["sensor", "logger"]


@dataclass(frozen=True)
class Reading:
    """The user's options for reading a log. If a field is None or empty, the value in the log is used."""

    mount: Array | None = None  # (3,) laser in base_link
    scan_topic: str = ""  # for CARMEN logs the type of line, such as RLASER
    odom_topic: str = ""
    base_frame: str = ""
    upside_down: bool | None = None  # defaults to what tf states, otherwise False
    # False reads no reference poses; True also reads poses of CARMEN scans that differ from the odometry.
    reference: bool | None = None
    reference_topic: str = ""
    angles: tuple[float, float] | None = None  # rad, first and last beam, for lines that do not state them
    range_max: float | None = None  # m
    clock: Clock = "sensor"  # whose stamps are used

    @property
    def is_default(self) -> bool:
        """Whether the user gave no option."""
        return self.mount is None and self == Reading()


@dataclass(frozen=True)
class LoggedScan:
    """One scan of a log."""

    stamp_ns: int | None  # None if the log has no stamps
    ranges: Array  # (B,) m, in the convention of `common.robot.ranges.normalise_driver_ranges`
    odom: Array | None = None  # (3,) base_link in odom at the stamp
    reference: Array | None = None  # (3,) base_link in map


def check_ranges(path: Path, ranges: Array) -> None:
    """Raises UserError if a range in m is longer than any scanner measures."""
    if (longest := np.max(ranges, where=np.isfinite(ranges), initial=0.0)) > MAX_RANGE_M:
        raise UserError(
            f"{path}: has a range of {longest:g} m, but no scanner measures more than {MAX_RANGE_M:g} m: "
            "are the ranges in mm? If not, range_max is too large"
        )


@dataclass
class Log:
    """An opened log: everything that is known before its scans are read."""

    path: Path
    format: str  # description of the format, for messages
    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    scans: int  # number of scans in the file, including unusable ones
    read: Callable[[], Iterator[LoggedScan]]  # reads from the beginning; raises UserError if the file is damaged
    range_min: float = 0.0  # m
    time_increment: float = 0.0  # s between beams, as in a scan message
    mount_assumed: bool = False  # whether neither the log nor the user states the mount
    odometry: str = ""  # source of the odometry; empty if there is none
    reference: str = ""  # source of the reference poses; empty if there are none
    initial_pose: Array | None = None  # (3,) in map
    notes: list[str] = field(default_factory=list)  # assumptions that were made
    left_out: Counter[str] = field(default_factory=Counter)  # scans left out in the last pass, by reason
    left_out_other: Counter[str] = field(default_factory=Counter)  # other lines or messages left out, by reason

    def valid_scans(self) -> Iterator[LoggedScan]:
        """Yields the scans with increasing stamps and counts the others in `left_out`.

        Raises UserError if a range is longer than any scanner measures, and at the end if more scans were left out
        than used.
        """
        self.left_out.clear()
        self.left_out_other.clear()
        last, used = None, 0
        for scan in self.read():
            if last is not None and scan.stamp_ns is not None and scan.stamp_ns <= last:
                self.left_out["scans twice" if scan.stamp_ns == last else "scans older than the one before"] += 1
                continue
            check_ranges(self.path, scan.ranges)
            last, used = scan.stamp_ns, used + 1
            yield scan
        if self.left_out.total() > used:
            raise UserError(f"{self.path}: too few usable scans: {used}; left out: {self.describe_left_out()}")

    def note_resampled(self, count: int) -> None:
        """Adds the note, once, that ``count`` scans were resampled at the angles of the first scan."""
        note = f"{count} scans with other beam angles are resampled at the angles of the first scan"
        if count and note not in self.notes:
            self.notes.append(note)

    def describe_left_out(self) -> str:
        """What was left out and how often, as text for messages; empty if nothing was left out."""
        return ", ".join(f"{what}: {count}" for what, count in (self.left_out + self.left_out_other).items())
