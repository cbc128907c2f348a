"""A log: scanner geometry, and scans with odometry and reference poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from common.errors import UserError
from common.geometry.se2 import Array


@dataclass(frozen=True)
class Reading:
    """What the user says about a log; None and empty: as the log itself has it."""

    mount: Array | None = None  # (3,) laser in base_link
    scan_topic: str = ""  # of CARMEN: the line, such as RLASER
    odom_topic: str = ""
    base_frame: str = ""
    upside_down: bool | None = None  # the scanner hangs so; None: as tf says, else not
    reference: bool | None = None  # False: none; True: also poses that only claim to be corrected (CARMEN)
    reference_topic: str = ""
    angles: tuple[float, float] | None = None  # rad, first and last beam, where a line does not say
    range_max: float | None = None  # m
    clock: Literal["sensor", "logger"] = "sensor"  # whose stamps

    @property
    def plain(self) -> bool:
        """Whether nothing was said."""
        return self.mount is None and self == Reading()


@dataclass(frozen=True)
class LoggedScan:
    """One scan of a log."""

    stamp_ns: int | None  # None: the log has no times
    ranges: Array  # (B,) m, as `common.robot.ranges.normalise_driver_ranges` has them
    odom: Array | None = None  # (3,) base_link in odom at the stamp
    reference: Array | None = None  # (3,) base_link in map


@dataclass
class Log:
    """A log that was opened: what is known before its scans are read."""

    path: Path
    format: str  # for people
    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    scans: int  # that are in it, the unusable included
    read: Callable[[], Iterator[LoggedScan]]  # from the beginning; UserError where the file is damaged
    range_min: float = 0.0  # m
    mount_assumed: bool = False  # neither the log nor the user states the mount
    odometry: str = ""  # where it comes from; empty: there is none
    reference: str = ""  # what it is; empty: there is none
    initial_pose: Array | None = None  # (3,) in map
    notes: list[str] = field(default_factory=list)  # what was taken for granted
    left_out: Counter[str] = field(default_factory=Counter)  # of the last pass, scans: what, and how often
    left_out_beside: Counter[str] = field(default_factory=Counter)  # the same, of what is no scan

    def sweeps(self) -> Iterator[LoggedScan]:
        """Scans with growing stamps; the others are counted. UserError where hardly any can be used."""
        self.left_out.clear()
        self.left_out_beside.clear()
        last, used = None, 0
        for sweep in self.read():
            if last is not None and sweep.stamp_ns is not None and sweep.stamp_ns <= last:
                self.left_out["scans twice" if sweep.stamp_ns == last else "scans older than the one before"] += 1
                continue
            last, used = sweep.stamp_ns, used + 1
            yield sweep
        lost = self.left_out.total()
        if lost > used:
            raise UserError(f"{self.path}: too little of use: {used} scans; {self.lost()}")

    def note_fitted(self, count: int) -> None:
        """Adds the note, once, that ``count`` scans were brought to the first scan's angles."""
        note = f"{count} scans of other beams are brought to the angles of the first"
        if count and note not in self.notes:
            self.notes.append(note)

    def lost(self) -> str:
        """What was left out, in words; empty: nothing."""
        return ", ".join(f"{what}: {count}" for what, count in (self.left_out + self.left_out_beside).items())
