"""`presage import`: converts a log to a recording."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from rich.console import Console

from common.errors import UserError, first_fault
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World, load_world
from common.limits import MAX_SPEED
from common.messages.definitions import Odom, Pose, Scan, Stamped, Truth, Twist
from common.messages.requests import WorldReply
from common.messages.topics import ODOM, SCAN, TRUTH, Topic
from common.robot.scanner import Scanner
from common.versions import presage_command, versions
from presage.logs.log import Log, LoggedScan, Reading
from presage.logs.opening import IS_A_RECORDING, kind_of, open_log
from presage.terminal.output import check_file, provenance, write_json
from presage.terminal.progress import progress, working
from services.estimator.factory import DEFAULT_SIGMA_M
from services.recorder.files.message_counts import MessageCounts, as_metadata
from services.recorder.files.writer import RecordingWriter
from services.recorder.recording import write_description

MAX_ANGLE_DEVIATION = 1e-4  # rad, of a beam from evenly spaced angles
RATE_SCANS = 50  # first scans, from which the scan rate is determined
MAX_VELOCITY_GAP_S = 3.0  # between two poses; over a longer gap the velocity is recorded as zero


@dataclass(frozen=True)
class ImportOptions:
    """Options of `presage import`."""

    file: Path
    out: Path
    reading: Reading = Reading()  # noqa: RUF009 - frozen
    world: str = ""  # world name or file to store in the recording
    robot: str = "robot"
    laser: bool = False  # record the poses of the laser instead of base_link; the mount is then 0, 0, 0
    rate: float | None = None  # Hz, for a log without stamps
    sigma: float | None = None  # m, range noise; None leaves it unknown


def import_command(options: ImportOptions, json_file: Path | None, console: Console, err_console: Console) -> None:
    """Imports the log and prints a summary, with progress on ``err_console``.

    Raises UserError if the log cannot be imported; no file is left then.
    """
    check_file(json_file, "--json")
    if kind_of(options.file) == "recording":
        raise UserError(f"{options.file}: {IS_A_RECORDING}")
    if options.out.suffix != ".mcap":
        raise UserError(f"{options.out}: the name of a recording must end with .mcap")
    if options.out.exists():
        raise UserError(f"{options.out}: exists already; choose another name with --out")
    world = load_world(options.world) if options.world else None
    with working(f"reading {options.file.name}", err_console):
        log = _open(options)
    with closing(progress(log.valid_scans(), "importing", log.scans, err_console)) as logged_scans:
        written = write_recording(options, log, world, logged_scans)
    facts = written.facts(options, log)
    console.print(*_lines(options, log, facts), sep="\n", highlight=False, soft_wrap=True)
    write_json(json_file, {**facts, **provenance()})


def _open(options: ImportOptions) -> Log:
    """Opens the log; its poses are those of the frame that the options choose."""
    if not options.laser:
        return open_log(options.file, options.reading)
    if kind_of(options.file) == "npz":  # with mount zero, the poses of an .npz file are taken as the laser's
        return open_log(options.file, replace(options.reading, mount=np.zeros(3)))
    log = open_log(options.file, options.reading)
    mount = log.mount

    def laser_pose(pose: Array | None) -> Array | None:
        return None if pose is None else np.asarray(se2.compose(pose, mount))

    def logged_scans() -> Iterator[LoggedScan]:
        for logged in log.read():
            yield replace(logged, odom=laser_pose(logged.odom), reference=laser_pose(logged.reference))

    return replace(log, mount=np.zeros(3), mount_assumed=False, read=logged_scans)


@dataclass
class ImportCounts:
    """Counts of what was written to the recording."""

    scans: int = 0
    odoms: int = 0
    references: int = 0
    first_ns: int | None = None
    last_ns: int = 0
    message_counts: MessageCounts = field(default_factory=MessageCounts)

    def facts(self, options: ImportOptions, log: Log) -> dict[str, Any]:
        """Facts about the import, for --json and the metadata of the recording."""
        return {
            "file": str(options.file),
            "out": str(options.out),
            "format": log.format,
            "scans": self.scans,
            "beams": len(log.angles),
            "duration_s": (self.last_ns - (self.first_ns or 0)) * 1e-9,
            "odometry": log.odometry,
            "odometry_poses": self.odoms,
            "reference": log.reference,
            "reference_poses": self.references,
            "mount": log.mount.tolist(),
            "mount_assumed": log.mount_assumed,
            "left_out": dict(log.left_out + log.left_out_other),
            "notes": log.notes,
        }


def write_recording(
    options: ImportOptions, log: Log, world: World | None, logged_scans: Iterator[LoggedScan] | Any
) -> ImportCounts:
    """Writes all scans and poses to the recording; removes the recording if that fails."""
    start, step = beam_spacing(log)
    first_scans = list(itertools.islice(stamped := _stamped(log, logged_scans, options.rate), RATE_SCANS))
    if not first_scans:
        left_out = log.describe_left_out()
        raise UserError(f"{log.path}: no usable scan in it" + (f"; left out: {left_out}" if left_out else ""))
    period = float(np.median(np.diff([stamp for stamp, _ in first_scans])) * 1e-9) if len(first_scans) > 1 else 0.0
    writer, written = RecordingWriter(options.out), ImportCounts(first_ns=first_scans[0][0])
    try:
        writer.metadata("presage", {"robot": options.robot, "command": presage_command(), **versions()})
        scanner = scanner_of(log, start, step, period, options.sigma)
        write_description(writer, "simulator", WorldReply(world=world, scanner=scanner))
        message_writer = _MessageWriter(writer, options.robot, written)
        geometry = {
            "angle_min": start,
            "angle_increment": step,
            "range_min": log.range_min,
            "range_max": log.range_max,
            "mount": Pose.of(log.mount),
            "scan_time": period,
            "time_increment": log.time_increment,
            "sigma": options.sigma or 0.0,
        }
        for stamp_ns, logged in itertools.chain(first_scans, stamped):
            message_writer.write_scan(stamp_ns, logged, geometry)
        facts = written.facts(options, log)
        writer.metadata("log", {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()})
        counts = written.message_counts.written
        writer.metadata("counters", as_metadata(written.message_counts.counts(counts, {}, {})))
        writer.finish()
    except BaseException as error:
        writer.finish().unlink(missing_ok=True)
        if isinstance(error, ValidationError):
            raise UserError(f"{log.path}: cannot be stored in a recording ({first_fault(error)})") from None
        raise
    return written


def beam_spacing(log: Log) -> tuple[float, float]:
    """Angle of the first beam and angle between beams, rad; raises UserError if the beams are not evenly spaced."""
    start, step = float(log.angles[0]), float(log.angles[-1] - log.angles[0]) / (len(log.angles) - 1)
    if np.abs(start + step * np.arange(len(log.angles)) - log.angles).max() > MAX_ANGLE_DEVIATION or step == 0:
        raise UserError(f"{log.path}: its beams are not evenly spaced, as a recording requires")
    return start, step


def scanner_of(log: Log, start: float, step: float, period: float, sigma: float | None) -> Scanner | None:
    """The scanner as described in the recording; None if its rate is unknown or `Scanner` does not allow a value."""
    x, y, yaw = map(float, log.mount)
    fov = min(step * (len(log.angles) - 1), 2 * np.pi)  # in single precision, a full turn may exceed 2 pi
    try:
        return Scanner(
            name="log",
            beams=len(log.angles),
            fov=fov,
            rate=1 / period if period else 0.0,
            range_min=log.range_min,
            range_max=log.range_max,
            sigma=DEFAULT_SIGMA_M if sigma is None else sigma,
            mount=(x, y, yaw),
            first=start,
        )
    except ValidationError:
        return None


def _stamped(log: Log, logged_scans: Iterator[LoggedScan], rate: float | None) -> Iterator[tuple[int, LoggedScan]]:
    """Yields the scans with their stamps; raises UserError if a stamp is missing or negative."""
    for k, logged in enumerate(logged_scans):
        if logged.stamp_ns is None and rate is None:
            raise UserError(
                f"{log.path}: has no stamps: give the number of scans per second with rate in section log of --config"
            )
        stamp_ns = round(k * 1e9 / (rate or 1.0)) if logged.stamp_ns is None else logged.stamp_ns
        if stamp_ns < 0:
            raise UserError(f"{log.path}: its stamps begin below 0 s: add a constant to all of them")
        yield stamp_ns, logged


class _MessageWriter:
    """Writes scans, odometry and reference poses as the messages that services publish."""

    def __init__(self, writer: RecordingWriter, robot: str, written: ImportCounts) -> None:
        self._writer, self._robot, self._written = writer, robot, written
        self._last: dict[Topic, tuple[int, Array]] = {}

    def write_scan(self, stamp_ns: int, logged: LoggedScan, geometry: dict[str, Any]) -> None:
        """Writes odometry and reference pose before the scan, because the estimator needs the odometry first.

        ``geometry`` holds the fields that all scans have in common.
        """
        written = self._written
        if logged.odom is not None:
            # Covariance zero means unknown; covariances in logs are not imported.
            pose, twist = self._with_velocity(ODOM, stamp_ns, logged.odom)
            odom = Odom(stamp_ns=stamp_ns, seq=written.odoms, pose=pose, twist=twist, covariance=np.zeros((3, 3)))
            self._put(ODOM, odom, stamp_ns)
            written.odoms += 1
        if logged.reference is not None:
            pose, twist = self._with_velocity(TRUTH, stamp_ns, logged.reference)
            self._put(TRUTH, Truth(stamp_ns=stamp_ns, seq=written.references, pose=pose, twist=twist), stamp_ns + 1)
            written.references += 1
        ranges = np.asarray(logged.ranges, np.float32)
        scan = Scan(stamp_ns=stamp_ns, seq=written.scans, ranges=ranges, **geometry)
        self._put(SCAN, scan, stamp_ns + 2)
        written.scans += 1
        written.last_ns = stamp_ns

    def _with_velocity(self, topic: Topic, stamp_ns: int, pose: Array) -> tuple[Pose, Twist]:
        """The pose, and the mean velocity since the previous one, in base_link."""
        previous = self._last.get(topic)
        self._last[topic] = stamp_ns, pose
        if previous is None or not 0 < (seconds := (stamp_ns - previous[0]) * 1e-9) <= MAX_VELOCITY_GAP_S:
            return Pose.of(pose), Twist()
        velocity = se2.between(previous[1], pose) / seconds
        if np.abs(velocity).max() > MAX_SPEED:  # the pose was reset, or the stamps are almost equal
            return Pose.of(pose), Twist()
        vx, vy, wz = map(float, velocity)
        return Pose.of(pose), Twist(vx=vx, vy=vy, wz=wz)

    def _put(self, topic: Topic, message: Stamped, at_ns: int) -> None:
        key, payload = topic.key(self._robot), message.encode()
        self._writer.write(topic, key, payload, at_ns, at_ns)
        self._written.message_counts.add(key, payload)


def _lines(options: ImportOptions, log: Log, facts: dict[str, Any]) -> list[str]:
    """The summary of the import, one line each."""
    first, last = np.rad2deg(log.angles[[0, -1]])
    x, y, yaw = np.round([*log.mount[:2], np.rad2deg(log.mount[2])], 4) + 0.0  # avoids 1e-17 and -0
    lines = [
        f"{log.format}: {facts['scans']} scans of {facts['beams']} beams in {facts['duration_s']:.1f} s",
        f"scanner: {first:.1f} to {last:.1f} deg, up to {log.range_max:g} m, at {x:.4g},{y:.4g},{yaw:.4g} in base_link",
        f"odometry: {log.odometry or 'none'} ({facts['odometry_poses']} poses)",
        f"reference: {log.reference or 'none'} ({facts['reference_poses']} poses)",
        *log.notes,
    ]
    if left_out := log.describe_left_out():
        lines.append(f"left out: {left_out}")
    return [*lines, f"wrote {options.out}"]
