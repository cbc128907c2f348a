"""CARMEN logs."""

from __future__ import annotations

import bz2
import gzip
import lzma
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.robot.ranges import normalise_driver_ranges
from presage.logs.carmen_lines import LINE_TYPE, LaserLine, is_laser, laser_line, pose_line
from presage.logs.log import Clock, Log, LoggedScan, Reading
from presage.logs.pose_track import PoseTrack
from presage.logs.resampling import resample

MAX_LINE_CHARACTERS = 1 << 22  # far more than the lines of real logs; limits the memory for other files
# Tolerance in m, m, rad: if the mount computed from all scans varies less, the laser is fixed to the robot and the
# logged poses are odometry; else they were corrected.
MOUNT_TOLERANCE = np.array([0.01, 0.01, np.deg2rad(0.5)])
DECOMPRESSION_ERRORS = (EOFError, OSError, lzma.LZMAError, zlib.error)  # for a cut or damaged .gz, .bz2 or .xz

# Angles of the first and last beam in degrees, by number of beams, for lines that only state the number. 180 and 360
# are scans of 181 and 361 beams without the last.
SPANS_DEG = {
    101: (-50, 50),
    180: (-90, 89),
    181: (-90, 90),
    201: (-50, 50),
    360: (-90, 89.5),
    361: (-90, 90),
    401: (-50, 50),
    541: (-135, 135),
    1081: (-135, 135),
}
# A SICK LMS reports "no return" as a code of 81.83 m and more, or in its millimetre mode as 8.183 m and more. All in m.
LMS_FAR_RANGE_MAX, LMS_NEAR_RANGE_MAX = 80.0, 8.18
LMS_NEAR_CODES = (8.18, 8.192)
# What headers state as maximum range of such a laser: its limit, or its highest code, in the near and the far mode.
LMS_STATED_RANGES = ((8.18, 8.2), (LMS_FAR_RANGE_MAX, 82.0))
FIRST_PASS_SCANS = 100  # scans of each laser from which the maximum range and the clock are determined
# CARMEN's parameters describe a front and a rear laser; there are none of LASER3 and up.
FRONT = ("FLASER", "ROBOTLASER1", "RAWLASER1")
REAR = ("RLASER", "ROBOTLASER2", "RAWLASER2")
POSE_LINES = ("ODOM", "TRUEPOS")
CLOCKS: tuple[Clock, Clock] = ("sensor", "logger")  # in the order of the stamps of a line


@dataclass
class _FirstPass:
    """The results of the first pass over the file."""

    params: dict[str, str] = field(default_factory=dict)
    lasers: Counter[str] = field(default_factory=Counter)  # lines by name
    firsts: dict[str, list[LaserLine]] = field(default_factory=dict)  # the first lines of each laser
    mounts: dict[str, tuple[Array, Array]] = field(default_factory=dict)  # minimum and maximum of laser in base_link
    # Poses by the sensor's stamps (ipc), and by the logger's.
    odometry: dict[Clock, PoseTrack] = field(default_factory=lambda: {clock: PoseTrack() for clock in CLOCKS})
    reference: dict[Clock, PoseTrack] = field(default_factory=lambda: {clock: PoseTrack() for clock in CLOCKS})


def open_carmen(path: Path, reading: Reading) -> Log:
    """Opens a CARMEN log; raises UserError if it has no usable scans or an option does not fit it."""
    first_pass = _read_first_pass(path)
    if not first_pass.lasers:
        raise UserError(
            f"{path}: a CARMEN log without scans: no lines such as FLASER, RLASER, ROBOTLASER1 or RAWLASER1"
        )
    name = _choose_laser(path, first_pass.lasers, reading.scan_topic)
    if reading.odom_topic and (reading.odom_topic != "ODOM" or not len(first_pass.odometry["sensor"])):
        available = "ODOM lines" if len(first_pass.odometry["sensor"]) else "no ODOM lines"
        raise UserError(
            f"{path}: odom_topic {reading.odom_topic}: a CARMEN log can only have ODOM, and this one has {available}"
        )
    if not first_pass.firsts.get(name):
        raise UserError(f"{path}: every {name} line is malformed")
    notes: list[str] = []
    first = first_pass.firsts[name][0]
    angles, range_max = _angles(path, name, first, reading, notes), _range_max(first_pass, name, reading, notes)
    clock = _clock(first_pass.firsts[name], reading, notes)
    mount, corrected, assumed = _mount(first_pass, name, reading, notes)
    log = Log(
        path,
        f"CARMEN log ({name})",
        angles,
        mount,
        range_max,
        first_pass.lasers[name],
        lambda: iter(()),
        notes=notes,
        mount_assumed=assumed,
    )
    odometry = first_pass.odometry[clock] if first.robot is None or reading.odom_topic == "ODOM" else None
    reference = first_pass.reference[clock] if reading.reference is not False else PoseTrack()
    if odometry is None or len(odometry):
        log.odometry = f"{name}'s robot pose" if odometry is None else "ODOM, interpolated"
    if len(reference):
        log.reference = "the log's TRUEPOS"
    elif reading.reference and corrected:
        log.reference = f"{name}'s corrected pose"
    elif reading.reference:
        notes.append(f"no reference: the poses of {name} are odometry, and there are no TRUEPOS lines")
    # Scans with other beams can be resampled only if the angles in their headers are used.
    can_resample = reading.angles is None and first.beams is not None
    log.read = lambda: _read_scans(log, first, clock, odometry, reference, name, can_resample=can_resample)
    return log


def _choose_laser(path: Path, lasers: Counter[str], wanted: str) -> str:
    if wanted and wanted not in lasers:
        raise UserError(
            f"{path}: no {wanted} lines in it; it has {', '.join(sorted(lasers))}: "
            "choose one with scan_topic in section log of --config"
        )
    return wanted or next((name for name in FRONT if name in lasers), min(lasers))


def _angles(path: Path, name: str, first: LaserLine, reading: Reading, notes: list[str]) -> Array:
    """Beam angles (B,) rad, from the setting, the line's header, or the usual scanner with this number of beams."""
    count, header = len(first.ranges), first.beams
    if reading.angles is not None:
        return np.linspace(*reading.angles, count)
    if header is not None:
        return header.angles()
    if count not in SPANS_DEG:
        raise UserError(
            f"{path}: {name} does not state the angles of its {count} beams: give the first and the last one in "
            "a settings file, such as log: {angles: '-90,90'}"
        )
    first_deg, last_deg = SPANS_DEG[count]
    notes.append(
        f"assumed: the {count} beams cover {first_deg:g} to {last_deg:g} deg "
        "(change with angles in section log of --config)"
    )
    return np.deg2rad(np.linspace(first_deg, last_deg, count))


def _range_max(first_pass: _FirstPass, name: str, reading: Reading, notes: list[str]) -> float:
    """Range from which on there is no return, m: from the setting, the line's header, a PARAM line, or of an LMS."""
    lines = first_pass.firsts[name]
    if reading.range_max is not None:
        return reading.range_max
    longest = max(float(np.max(line.ranges)) for line in lines)
    near_codes = LMS_NEAR_CODES[0] <= longest <= LMS_NEAR_CODES[1]
    if (header := lines[0].beams) is not None:
        stated = header.range_max
    else:
        try:
            stated = float(first_pass.params.get(f"robot_{_side(name)}_laser_max", ""))
        except ValueError:
            stated = 0.0
    near, far = (low <= stated <= high for low, high in LMS_STATED_RANGES)
    # A PARAM line does not know the mode of an LMS.
    if not (near or far or (header is None and near_codes)) and 0 < stated < np.inf:
        return stated
    range_max = LMS_NEAR_RANGE_MAX if near or near_codes else LMS_FAR_RANGE_MAX
    if range_max != stated:
        notes.append(
            f"assumed: ranges from {range_max:g} m on mean no return (change with range_max in section log of --config)"
        )
    return range_max


def _clock(lines: list[LaserLine], reading: Reading, notes: list[str]) -> Clock:
    """Returns whose stamps to use: the sensor's (ipc), or the logger's, also if the sensor's do not advance."""
    if reading.clock == "logger":
        return "logger"
    if len(lines) > 1 and lines[0].ipc == lines[-1].ipc:
        notes.append("the ipc timestamps do not advance: the timestamps of the logger are used")
        return "logger"
    return "sensor"


def _mount(first_pass: _FirstPass, name: str, reading: Reading, notes: list[str]) -> tuple[Array, bool, bool]:
    """Returns the laser in base_link (3,), whether the laser's poses were corrected, and whether the mount is assumed.

    The poses were corrected by a mapping program if their offset from the odometry is not constant.
    """
    low, high = first_pass.mounts.get(name, (np.zeros(3), np.full(3, np.inf)))
    is_constant = bool((high - low <= 2 * MOUNT_TOLERANCE).all())
    corrected = name in first_pass.mounts and not is_constant
    if reading.mount is not None:
        return reading.mount, corrected, False
    if is_constant:
        return (low + high) / 2, corrected, False
    side = _side(name)
    names = [f"robot_{side}laser_{part}" for part in ("offset", "side_offset", "angular_offset")]
    try:
        mount = np.array([float(first_pass.params.get(each, 0)) if side else 0.0 for each in names])
    except ValueError:
        mount = np.zeros(3)
    if side == "rear" and names[2] not in first_pass.params:  # logs older than this parameter, which is the whole angle
        mount[2] = np.pi
    text = ",".join(f"{number:g}" for number in (*mount[:2], np.rad2deg(mount[2])))
    notes.append(f"assumed: the laser is mounted at {text} in base_link (change with --mount)")
    return mount, corrected, not first_pass.params.keys() & set(names)


def _side(name: str) -> str:
    """The laser's side in names of parameters: front or rear, or "" for another laser."""
    return "front" if name in FRONT else "rear" if name in REAR else ""


def _read_first_pass(path: Path) -> _FirstPass:
    """Reads the whole file once for parameters, poses, and the first scans of each laser."""
    first_pass = _FirstPass()
    for words in _read_words(path):
        try:
            if words[0] == "PARAM" and len(words) > 2:
                first_pass.params[words[1]] = words[2]
            elif words[0] in POSE_LINES:
                pose, *times = pose_line(words)
                tracks = first_pass.odometry if words[0] == "ODOM" else first_pass.reference
                for clock, time in zip(CLOCKS, times, strict=True):
                    tracks[clock].add(round(time * 1e9), pose)
            elif is_laser(words[0]):
                first_pass.lasers[words[0]] += 1
                _record_laser(first_pass, words)
        except (ValueError, IndexError):  # malformed lines are counted when the scans are read
            continue
    return first_pass


def _record_laser(first_pass: _FirstPass, words: list[str]) -> None:
    name = words[0]
    firsts = first_pass.firsts.setdefault(name, [])
    keep = len(firsts) < FIRST_PASS_SCANS
    line = laser_line(words, ranges=keep)
    if keep:
        firsts.append(line)
    if line.laser is not None and line.robot is not None:
        mount = se2.between(line.robot, line.laser)
        low, high = first_pass.mounts.get(name, (mount, mount))
        unwrapped_yaw = low[2] + se2.wrap(mount[2] - low[2])  # the yaw of a rear scanner is near both pi and -pi
        mount = np.array([*mount[:2], unwrapped_yaw])
        first_pass.mounts[name] = np.minimum(low, mount), np.maximum(high, mount)


def _read_scans(
    log: Log,
    first: LaserLine,
    clock: Clock,
    odometry: PoseTrack | None,
    reference: PoseTrack,
    name: str,
    *,
    can_resample: bool,
) -> Iterator[LoggedScan]:
    """Yields the scans. The line's own poses are used if ``odometry`` is None, and if ``reference`` is empty."""
    resampled_scans = 0
    for words in _read_words(log.path):
        if words[0] != name:
            if not LINE_TYPE.match(words[0]):
                log.left_out["malformed lines"] += 1
            elif words[0] in POSE_LINES and not _is_pose(words):
                log.left_out_other[f"malformed {words[0]} lines"] += 1
            continue
        try:
            line = laser_line(words)
        except (ValueError, IndexError):
            log.left_out["malformed lines"] += 1
            continue
        measured = normalise_driver_ranges(line.ranges, 0.0, log.range_max)
        ranges = _resample(first, line, measured, log.angles, can_resample=can_resample)
        if ranges is None:
            log.left_out["scans with other beam angles"] += 1
            continue
        resampled_scans += ranges is not measured
        stamp = round((line.logger if clock == "logger" else line.ipc) * 1e9)
        reference_pose = None
        if len(reference):
            reference_pose = reference.at(stamp)
        elif log.reference and line.laser is not None:
            reference_pose = se2.compose(line.laser, se2.inverse(log.mount))
        yield LoggedScan(stamp, ranges, line.robot if odometry is None else odometry.at(stamp), reference_pose)
    log.note_resampled(resampled_scans)


def _resample(first: LaserLine, line: LaserLine, ranges: Array, angles: Array, *, can_resample: bool) -> Array | None:
    """The line's ``ranges`` at the first line's ``angles``; an interlaced LMS shifts its beams by 0.25 deg each scan.

    Returns None if the scan cannot be resampled.
    """
    if line.beams == first.beams and len(ranges) == len(angles):
        return ranges
    if not can_resample or line.beams is None or first.beams is None or line.beams.range_max != first.beams.range_max:
        return None
    return resample(ranges, line.beams.angles(), angles)


def _is_pose(words: list[str]) -> bool:
    try:
        pose_line(words)
    except (ValueError, IndexError):
        return False
    return True


def _read_words(path: Path) -> Iterator[list[str]]:
    """Yields the words of each line, without comments; raises UserError if the file cannot be read to its end."""
    try:
        with path.open("rb") as raw, decompressed(raw) as stream:
            while line := stream.readline(MAX_LINE_CHARACTERS):
                words = line.decode("ascii", "replace").split()
                if words and not words[0].startswith("#"):
                    yield words
    except DECOMPRESSION_ERRORS as error:
        raise UserError(
            f"{path}: cut short or damaged ({error}); copy or download it again, or unpack the intact part and use that"
        ) from None


def decompressed(raw: BinaryIO) -> BinaryIO:
    """A stream of the decompressed .gz, .bz2 or .xz file, recognised from its first bytes; else ``raw`` itself."""
    magic = raw.read(6)
    raw.seek(0)
    if magic.startswith(b"\x1f\x8b"):
        return gzip.open(raw)  # type: ignore[return-value]
    if magic.startswith(b"BZh"):
        return bz2.open(raw)  # type: ignore[return-value]
    if magic == b"\xfd7zXZ\x00":
        return lzma.open(raw)  # type: ignore[return-value]
    return raw
