"""Reads all scans of a log or recording into memory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console

from common.errors import UserError
from common.geometry.se2 import Array
from common.messages.definitions import Odom, Scan, Truth
from common.messages.topics import ODOM, SCAN, TRUTH
from common.robot.ranges import ranges_for_localisation
from presage.logs.log import Log, Reading
from presage.logs.opening import kind_of, open_log
from services.estimator.factory import Geometry
from services.estimator.shared.interface import Observation
from services.recorder.reader import Recording, read_recording

RECORDED_TRUTH = "the recorded truth"


@dataclass(frozen=True)
class Scans:
    """N scans of B beams."""

    geometry: Geometry
    ranges: Array  # (N, B) m; +inf for no return, -inf for not measured
    stamps: Array | None = None  # (N,) s
    odom: Array | None = None  # (N, 3) base_link in odom; NaN where unknown
    initial_pose: Array | None = None  # (3,) in map
    truth: Array | None = None  # (N, 3) base_link in map; NaN where unknown
    world: str | None = None  # name of the recorded world
    truth_is: str = RECORDED_TRUTH  # source of `truth`: the recorded truth, or the reference of a log
    notes: tuple[str, ...] = ()  # assumptions, and what was left out

    def print_notes(self, console: Console) -> None:
        """Prints the notes, one line each."""
        for note in self.notes:
            console.print(note, highlight=False, soft_wrap=True)

    def part(self, numbers: npt.NDArray[np.intp]) -> Scans:
        """Selects the scans with the given indices (K,), ascending.

        The initial pose belongs to the first scan and is dropped if that is not selected.
        """

        def of(values: Array | None) -> Array | None:
            return None if values is None else values[numbers]

        return replace(
            self, ranges=self.ranges[numbers], stamps=of(self.stamps), odom=of(self.odom), truth=of(self.truth),
            initial_pose=self.initial_pose if numbers[0] == 0 else None,
        )  # fmt: skip

    def observation(self, k: int, *, odometry: bool = True) -> Observation:
        """The k-th scan as an estimator's observation."""
        odom = self.odom[k] if odometry and self.odom is not None and np.isfinite(self.odom[k]).all() else None
        stamp = None if self.stamps is None else float(self.stamps[k])
        return Observation(self.ranges[k], self.geometry.angles, self.geometry.range_max, stamp, odom)


def read_scans(path: Path, mount: Array | None = None, reading: Reading | None = None) -> Scans:
    """Reads all scans of a recording, an .npz file, a CARMEN log or a ROS bag; raises UserError if that fails.

    ``mount`` (3,) is the laser in base_link; it replaces the mount of a log and is ignored for a recording. The poses
    in an .npz file (odom, initial_pose, reference) are those of base_link; with a mount of zero they are those of the
    laser. `Scans.truth` is the truth of a recording or the reference of a log. ``reading`` has further options for
    logs.
    """
    reading = reading or Reading()
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
    for sweep in log.sweeps():
        ranges.append(ranges_for_localisation(sweep.ranges))
        stamps.append(sweep.stamp_ns)
        odoms.append(unknown if sweep.odom is None else sweep.odom)
        references.append(unknown if sweep.reference is None else sweep.reference)
    left_out = log.describe_left_out()
    if not ranges:
        raise UserError(f"{log.path}: no usable scan in it" + (f"; left out: {left_out}" if left_out else ""))
    times = [stamp for stamp in stamps if stamp is not None]
    return Scans(
        Geometry(log.angles, log.mount, log.range_max, mount_assumed=log.mount_assumed),
        np.array(ranges),
        seconds(times) if len(times) == len(ranges) else None,
        np.array(odoms) if log.odometry else None,
        log.initial_pose,
        np.array(references) if log.reference else None,
        truth_is=log.reference or RECORDED_TRUTH,
        notes=(*log.notes, *([f"left out: {left_out}"] if left_out else [])),
    )


def mount_assumed(recording: Recording) -> bool:
    """Whether the recording was imported from a log that does not state the mount of the laser."""
    return recording.metadata.get("log", {}).get("mount_assumed") == "true"


def _read_recording(path: Path) -> Scans:
    recording = read_recording(path)
    scans: list[Scan] = []
    odoms: dict[int, Array] = {}
    truths: dict[int, Array] = {}
    for _, message, _ in recording.messages(SCAN, ODOM, TRUTH):
        if isinstance(message, Scan) and (not scans or message.stamp_ns > scans[-1].stamp_ns):
            scans.append(message)
        elif isinstance(message, Odom):
            odoms[message.stamp_ns] = message.pose.array()
        elif isinstance(message, Truth):
            truths[message.stamp_ns] = message.pose.array()
    if recording.warning:  # damage is only found while reading
        print(recording.warning)
    if not scans:
        raise UserError(f"{path}: no scan in it")
    first = scans[0]
    alike = [s for s in scans if len(s.ranges) == len(first.ranges) and s.mount == first.mount]
    if len(alike) != len(scans):
        raise UserError(f"{path}: the scanner changes during the recording; only one scanner per file is supported")
    unknown = np.full(3, np.nan)
    world = recording.world()
    return Scans(
        replace(Geometry.of_scan(first), mount_assumed=mount_assumed(recording)),
        np.array([ranges_for_localisation(s.ranges) for s in scans]),
        seconds([s.stamp_ns for s in scans]),
        np.array([odoms.get(s.stamp_ns, unknown) for s in scans]) if odoms else None,
        None,
        np.array([truths.get(s.stamp_ns, unknown) for s in scans]) if truths else None,
        world.name if world is not None else None,
        recording.metadata.get("log", {}).get("reference") or RECORDED_TRUTH,
    )
