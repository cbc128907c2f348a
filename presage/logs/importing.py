"""`presage import`: a log as a recording."""

from __future__ import annotations

import itertools
import json
import sys
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
from common.versions import commit, versions
from presage.logs.log import Log, LoggedScan, Reading
from presage.logs.opening import RECORDING, kind_of, open_log
from presage.terminal.output import check_file, write_json
from presage.terminal.progress import progress, working
from services.estimator.factory import SIGMA
from services.recorder.files.message_counts import Ledger, as_metadata
from services.recorder.files.writer import RecordingWriter
from services.recorder.recording import write_description

EVEN = 1e-4  # rad, by which a beam may lie beside its place
HEAD = 50  # scans by which the rate is known
STANDSTILL = 3.0  # s; over a longer gap nothing is said of the velocity


@dataclass(frozen=True)
class ImportOptions:
    """What is asked for."""

    file: Path
    out: Path
    reading: Reading = Reading()  # noqa: RUF009 - frozen
    world: str = ""  # a shipped one or a file; empty: none
    robot: str = "robot"
    laser: bool = False  # poses in the recording are the laser's, which then sits at 0, 0, 0
    rate: float | None = None  # Hz, of a log without times
    sigma: float | None = None  # m, the scanner's noise; None: the recording does not state it


def import_command(job: ImportOptions, json_file: Path | None, console: Console, err_console: Console) -> None:
    """Everything, with progress on ``err_console``; raises UserError in one line, and leaves no file then."""
    check_file(json_file, "--json")
    if kind_of(job.file) == "recording":
        raise UserError(f"{job.file}: {RECORDING}")
    if job.out.suffix != ".mcap":
        raise UserError(f"{job.out}: a recording is named NAME.mcap")
    if job.out.exists():
        raise UserError(f"{job.out}: is there already; choose another name with --out")
    world = load_world(job.world) if job.world else None
    with working(f"reading {job.file.name}", err_console):
        log = open_for(job)
    with closing(progress(log.sweeps(), "importing", log.scans, err_console)) as sweeps:
        written = write_recording(job, log, world, sweeps)
    facts = written.facts(job, log)
    console.print(*_lines(job, log, facts), sep="\n", highlight=False, soft_wrap=True)
    write_json(json_file, {**facts, "commit": commit(), "versions": versions(), "arguments": sys.argv[1:]})


def open_for(job: ImportOptions) -> Log:
    """The log, its poses those of the frame that was asked for; raises UserError."""
    if not job.laser:
        return open_log(job.file, job.reading)
    if kind_of(job.file) == "npz":  # its poses are the laser's as they stand
        return open_log(job.file, replace(job.reading, mount=np.zeros(3)))
    log = open_log(job.file, job.reading)
    mount = log.mount

    def of_laser(pose: Array | None) -> Array | None:
        return None if pose is None else np.asarray(se2.compose(pose, mount))

    def sweeps() -> Iterator[LoggedScan]:
        for sweep in log.read():
            yield replace(sweep, odom=of_laser(sweep.odom), reference=of_laser(sweep.reference))

    return replace(log, mount=np.zeros(3), mount_assumed=False, read=sweeps)


@dataclass
class Written:
    """What a recording got."""

    scans: int = 0
    odoms: int = 0
    references: int = 0
    first_ns: int | None = None
    last_ns: int = 0
    ledger: Ledger = field(default_factory=Ledger)

    def facts(self, job: ImportOptions, log: Log) -> dict[str, Any]:
        """Plain numbers, for --json and the recording's metadata."""
        return {
            "file": str(job.file), "out": str(job.out), "format": log.format, "scans": self.scans,
            "beams": len(log.angles), "duration_s": (self.last_ns - (self.first_ns or 0)) * 1e-9,
            "odometry": log.odometry, "odometry_poses": self.odoms,
            "reference": log.reference, "reference_poses": self.references,
            "mount": log.mount.tolist(), "mount_assumed": log.mount_assumed,
            "left_out": dict(log.left_out + log.left_out_beside), "notes": log.notes,
        }  # fmt: skip


def write_recording(job: ImportOptions, log: Log, world: World | None, sweeps: Iterator[LoggedScan] | Any) -> Written:
    """Scan after scan; an unfinished recording is not kept."""
    start, step = evenly(log)
    begun = list(itertools.islice(stamped := _stamped(log, sweeps, job.rate), HEAD))
    if not begun:
        raise UserError(f"{log.path}: no scan of use in it" + (f" ({lost})" if (lost := log.lost()) else ""))
    period = float(np.median(np.diff([stamp for stamp, _ in begun])) * 1e-9) if len(begun) > 1 else 0.0
    writer, written = RecordingWriter(job.out), Written(first_ns=begun[0][0])
    try:
        writer.metadata("presage", {"robot": job.robot, "command": " ".join(sys.argv), **versions()})
        scanner = scanner_of(log, start, step, period, job.sigma)
        write_description(writer, "simulator", WorldReply(world=world, scanner=scanner))
        sender = _Sender(writer, job.robot, written)
        template = Scan(
            stamp_ns=0, angle_min=start, angle_increment=step, range_min=log.range_min, range_max=log.range_max,
            ranges=np.zeros(0, np.float32), mount=Pose.of(log.mount), scan_time=period,
            sigma=job.sigma or 0.0,
        )  # fmt: skip
        for stamp_ns, sweep in itertools.chain(begun, stamped):
            sender.send(stamp_ns, sweep, template)
        facts = written.facts(job, log)
        writer.metadata("log", {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()})
        counts = written.ledger.written
        writer.metadata("counters", as_metadata(written.ledger.counts(counts, {}, {})))
        writer.finish()
    except BaseException as error:
        writer.finish().unlink(missing_ok=True)
        if isinstance(error, ValidationError):
            raise UserError(f"{log.path}: cannot be a recording ({first_fault(error)})") from None
        raise
    return written


def evenly(log: Log) -> tuple[float, float]:
    """First beam and the angle between beams, rad; raises UserError where they are not evenly spaced."""
    start, step = float(log.angles[0]), float(log.angles[-1] - log.angles[0]) / (len(log.angles) - 1)
    if np.abs(start + step * np.arange(len(log.angles)) - log.angles).max() > EVEN or step == 0:
        raise UserError(f"{log.path}: its beams are not evenly spaced, which a recording's are")
    return start, step


def scanner_of(log: Log, start: float, step: float, period: float, sigma: float | None) -> Scanner | None:
    """What the recording says of the scanner; None where its rate is not known, or a `Scanner` cannot be so."""
    x, y, yaw = map(float, log.mount)
    fov = min(step * (len(log.angles) - 1), 2 * np.pi)  # in single precision a turn is a little more
    try:
        return Scanner(
            name="log", beams=len(log.angles), fov=fov, rate=1 / period if period else 0.0,
            range_min=log.range_min, range_max=log.range_max, sigma=SIGMA if sigma is None else sigma,
            mount=(x, y, yaw), first=start,
        )  # fmt: skip
    except ValidationError:
        return None


def _stamped(log: Log, sweeps: Iterator[LoggedScan], rate: float | None) -> Iterator[tuple[int, LoggedScan]]:
    """With a time each."""
    for k, sweep in enumerate(sweeps):
        if sweep.stamp_ns is None and rate is None:
            raise UserError(f"{log.path}: has no stamps: say how many scans a second it has, with --rate")
        stamp_ns = round(k * 1e9 / (rate or 1.0)) if sweep.stamp_ns is None else sweep.stamp_ns
        if stamp_ns < 0:
            raise UserError(f"{log.path}: its stamps begin below 0 s: add a constant to all of them")
        yield stamp_ns, sweep


class _Sender:
    """Writes what the services would have published, one message behind the other."""

    def __init__(self, writer: RecordingWriter, robot: str, written: Written) -> None:
        self._writer, self._robot, self._written = writer, robot, written
        self._last: dict[Topic, tuple[int, Array]] = {}

    def send(self, stamp_ns: int, sweep: LoggedScan, template: Scan) -> None:
        """Odometry and reference come before the scan, as the estimator takes them."""
        written = self._written
        if sweep.odom is not None:
            # The covariance is not known: the log's own, where there is one, is not taken over.
            pose, twist = self._moving(ODOM, stamp_ns, sweep.odom)
            odom = Odom(stamp_ns=stamp_ns, seq=written.odoms, pose=pose, twist=twist, covariance=np.zeros((3, 3)))
            self._put(ODOM, odom, stamp_ns)
            written.odoms += 1
        if sweep.reference is not None:
            pose, twist = self._moving(TRUTH, stamp_ns, sweep.reference)
            self._put(TRUTH, Truth(stamp_ns=stamp_ns, seq=written.references, pose=pose, twist=twist), stamp_ns + 1)
            written.references += 1
        ranges = np.asarray(sweep.ranges, np.float32)
        scan = Scan(**{**dict(template), "stamp_ns": stamp_ns, "seq": written.scans, "ranges": ranges})
        self._put(SCAN, scan, stamp_ns + 2)
        written.scans += 1
        written.last_ns = stamp_ns

    def _moving(self, topic: Topic, stamp_ns: int, pose: Array) -> tuple[Pose, Twist]:
        """The pose, and the velocity since the last."""
        before = self._last.get(topic)
        self._last[topic] = stamp_ns, pose
        if before is None or not 0 < (seconds := (stamp_ns - before[0]) * 1e-9) <= STANDSTILL:
            return Pose.of(pose), Twist()
        velocity = se2.between(before[1], pose) / seconds
        if np.abs(velocity).max() > MAX_SPEED:  # the pose was set anew, or two stamps are almost the same
            return Pose.of(pose), Twist()
        vx, vy, wz = map(float, velocity)
        return Pose.of(pose), Twist(vx=vx, vy=vy, wz=wz)

    def _put(self, topic: Topic, message: Stamped, at_ns: int) -> None:
        key, payload = topic.key(self._robot), message.encode()
        self._writer.write(topic, key, payload, at_ns, at_ns)
        self._written.ledger.see(key, payload)


def _lines(job: ImportOptions, log: Log, facts: dict[str, Any]) -> list[str]:
    """What a user wants to know of it."""
    first, last = np.rad2deg(log.angles[[0, -1]])
    x, y, yaw = np.round([*log.mount[:2], np.rad2deg(log.mount[2])], 4) + 0.0  # no 1e-17, no -0
    lines = [
        f"{log.format}: {facts['scans']} scans of {facts['beams']} beams in {facts['duration_s']:.1f} s",
        f"scanner: {first:.1f} to {last:.1f} deg, up to {log.range_max:g} m, at {x:.4g},{y:.4g},{yaw:.4g} in base_link",
        f"odometry: {log.odometry or 'none'} ({facts['odometry_poses']} poses)",
        f"reference: {log.reference or 'none'} ({facts['reference_poses']} poses)",
        *log.notes,
    ]
    if lost := log.lost():
        lines.append(f"left out: {lost}")
    return [*lines, f"wrote {job.out}"]
