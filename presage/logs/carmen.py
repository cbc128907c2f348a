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
from presage.logs.carmen_lines import WORD, LaserLine, is_laser, laser_line, pose_line
from presage.logs.log import Log, LoggedScan, Reading
from presage.logs.poses import Track
from presage.logs.resampling import resampled

LONGEST = 1 << 22  # characters of a line; no log has such
SAME = np.array([0.01, 0.01, np.deg2rad(0.5)])  # m, m, rad: a laser that moves less against the robot is bolted to it
BROKEN = (EOFError, OSError, lzma.LZMAError, zlib.error)  # what a cut or damaged .gz, .bz2, .xz raises

# Degrees from the first beam to the last, where a line only says how many there are. 180 and 360 lack the last of 181
# and 361.
SPANS = {
    101: (-50, 50), 180: (-90, 89), 181: (-90, 90), 201: (-50, 50), 360: (-90, 89.5), 361: (-90, 90), 401: (-50, 50),
    541: (-135, 135), 1081: (-135, 135),
}  # fmt: skip
LMS_FAR = 80.0  # m; SICK's LMS says 81.83 m and more for "nothing", or 8.183 in its mode of millimetres
LMS_NEAR, CODES = 8.18, (8.18, 8.192)  # m
LMS_STATED = ((8.18, 8.2), (LMS_FAR, 82.0))  # m: what headers state of such a laser: its limit, or its highest code
LOOKED_AT = 100  # scans, for that
FRONT = ("FLASER", "ROBOTLASER1", "RAWLASER1")  # CARMEN's PARAMs are of these two; of LASER3 and up there are none
REAR = ("RLASER", "ROBOTLASER2", "RAWLASER2")
POSE_LINES = ("ODOM", "TRUEPOS")


@dataclass
class _Survey:
    """What a first pass finds."""

    params: dict[str, str] = field(default_factory=dict)
    lasers: Counter[str] = field(default_factory=Counter)  # lines by name
    firsts: dict[str, list[LaserLine]] = field(default_factory=dict)  # the first of each laser
    mounts: dict[str, tuple[Array, Array]] = field(default_factory=dict)  # least and largest laser in base_link
    odom: tuple[Track, Track] = field(default_factory=lambda: (Track(), Track()))  # by ipc and by logger
    true: tuple[Track, Track] = field(default_factory=lambda: (Track(), Track()))


def open_carmen(path: Path, reading: Reading) -> Log:
    """Raises UserError saying what is wrong."""
    survey = _survey(path)
    if not survey.lasers:
        raise UserError(f"{path}: a CARMEN log without a scan (FLASER, ROBOTLASER1, RAWLASER1 lines)")
    name = _choose(path, survey.lasers, reading.scan_topic)
    if reading.odom_topic and (reading.odom_topic != "ODOM" or not len(survey.odom[0])):
        there = "ODOM lines" if len(survey.odom[0]) else "no ODOM lines"
        raise UserError(
            f"{path}: --odom-topic {reading.odom_topic}: of a CARMEN log it can only be ODOM, and this one has {there}"
        )
    if not survey.firsts.get(name):
        raise UserError(f"{path}: every {name} line is garbled")
    notes: list[str] = []
    first = survey.firsts[name][0]
    angles, range_max = _angles(path, name, first, reading, notes), _range_max(survey, name, reading, notes)
    clock = _clock(survey.firsts[name], reading, notes)
    mount, corrected, assumed = _mount(survey, name, reading, notes)
    log = Log(
        path, f"CARMEN log ({name})", angles, mount, range_max, survey.lasers[name], lambda: iter(()), notes=notes,
        mount_assumed=assumed,
    )  # fmt: skip
    odom = survey.odom[clock] if first.robot is None or reading.odom_topic == "ODOM" else None
    true = survey.true[clock] if len(survey.true[clock]) and reading.reference is not False else None
    if odom is None or len(odom):
        log.odometry = f"{name}'s robot pose" if odom is None else "ODOM, interpolated"
    if true is not None:
        log.reference = "the log's TRUEPOS"
    elif reading.reference and corrected:
        log.reference = f"{name}'s corrected pose"
    elif reading.reference:
        notes.append(f"no reference: {name}'s poses are its odometry, and there are no TRUEPOS lines")
    # With --angles a header does not count, and nothing says where the beams of another header would be.
    fixed = reading.angles is not None or first.beams is None
    log.read = lambda: _sweeps(log, first, clock, odom, true, name, fixed=fixed)
    return log


def _choose(path: Path, there: Counter[str], wanted: str) -> str:
    if wanted and wanted not in there:
        raise UserError(f"{path}: no {wanted} lines in it; it has {', '.join(sorted(there))}: choose with --scan-topic")
    return wanted or next((name for name in FRONT if name in there), min(there))


def _angles(path: Path, name: str, first: LaserLine, reading: Reading, notes: list[str]) -> Array:
    """(B,) rad, by --angles, the line's header, or what a scanner of so many beams usually is."""
    count, said = len(first.ranges), first.beams
    if reading.angles is not None:
        return np.linspace(*reading.angles, count)
    if said is not None:
        return said.angles()
    if count not in SPANS:
        raise UserError(
            f"{path}: {name} does not say where its {count} beams look: say it, such as --angles -90,90 (first, last)"
        )
    first_deg, last_deg = SPANS[count]
    notes.append(f"{count} beams are taken to look from {first_deg:g} to {last_deg:g} deg (--angles)")
    return np.deg2rad(np.linspace(first_deg, last_deg, count))


def _range_max(survey: _Survey, name: str, reading: Reading, notes: list[str]) -> float:
    """From which on a range is no return, m: by --range-max, the line's header, PARAM, or as an LMS has it."""
    lines = survey.firsts[name]
    if reading.range_max is not None:
        return reading.range_max
    codes = CODES[0] <= max(float(np.max(line.ranges)) for line in lines) <= CODES[1]
    if (said := lines[0].beams) is not None:
        near, far = (low <= said.range_max <= high for low, high in LMS_STATED)
        if not near and not far:
            return said.range_max
        range_max, stated = LMS_NEAR if near or codes else LMS_FAR, said.range_max
    else:
        param = survey.params.get(f"robot_{_side(name)}_laser_max", "")
        try:
            stated = float(param)
        except ValueError:
            stated = 0.0
        range_max = LMS_NEAR if codes else stated if 0 < stated < np.inf else LMS_FAR
    if range_max != stated:
        notes.append(f"ranges from {range_max:g} m on are taken for no return (--range-max)")
    return range_max


def _clock(lines: list[LaserLine], reading: Reading, notes: list[str]) -> int:
    """0: ipc's times, 1: the logger's, which also serve where ipc's stand still."""
    if reading.clock == "logger":
        return 1
    if len(lines) > 1 and lines[0].ipc == lines[-1].ipc:
        notes.append("the ipc timestamps stand still: the logger's are taken")
        return 1
    return 0


def _mount(survey: _Survey, name: str, reading: Reading, notes: list[str]) -> tuple[Array, bool, bool]:
    """(3,) laser in base_link, whether its poses are corrected (do not stay with the odometry), and whether assumed."""
    least, largest = survey.mounts.get(name, (np.zeros(3), np.full(3, np.inf)))
    bolted = bool((largest - least <= 2 * SAME).all())
    corrected = name in survey.mounts and not bolted
    if reading.mount is not None:
        return reading.mount, corrected, False
    if bolted:
        return (least + largest) / 2, corrected, False
    side = _side(name)
    names = [f"robot_{side}laser_{part}" for part in ("offset", "side_offset", "angular_offset")]
    try:
        mount = np.array([float(survey.params.get(each, 0)) if side else 0.0 for each in names])
    except ValueError:
        mount = np.zeros(3)
    if side == "rear":
        mount[2] += np.pi
    words = ",".join(f"{number:g}" for number in (*mount[:2], np.rad2deg(mount[2])))
    notes.append(f"the laser is taken to sit at {words} in base_link (--mount says where it does)")
    return mount, corrected, not survey.params.keys() & set(names)


def _side(name: str) -> str:
    """Front or rear, as PARAMs call it; empty of any other laser."""
    return "front" if name in FRONT else "rear" if name in REAR else ""


def _survey(path: Path) -> _Survey:
    survey = _Survey()
    for words in _lines(path):
        try:
            if words[0] == "PARAM" and len(words) > 2:
                survey.params[words[1]] = words[2]
            elif words[0] in POSE_LINES:
                pose, *times = pose_line(words)
                for track, time in zip(survey.odom if words[0] == "ODOM" else survey.true, times, strict=True):
                    track.add(round(time * 1e9), pose)
            elif is_laser(words[0]):
                survey.lasers[words[0]] += 1
                _note_laser(survey, words)
        except (ValueError, IndexError):  # counted where scans are read
            continue
    return survey


def _note_laser(survey: _Survey, words: list[str]) -> None:
    name = words[0]
    firsts = survey.firsts.setdefault(name, [])
    looked_at = len(firsts) < LOOKED_AT
    line = laser_line(words, ranges=looked_at)
    if looked_at:
        firsts.append(line)
    if line.laser is not None and line.robot is not None:
        mount = se2.between(line.robot, line.laser)
        least, largest = survey.mounts.get(name, (mount, mount))
        turned = least[2] + se2.wrap(mount[2] - least[2])  # a scanner that looks back is near pi and -pi
        mount = np.array([*mount[:2], turned])
        survey.mounts[name] = np.minimum(least, mount), np.maximum(largest, mount)


def _sweeps(
    log: Log, first: LaserLine, clock: int, odom: Track | None, true: Track | None, name: str, *, fixed: bool
) -> Iterator[LoggedScan]:
    fitted = 0
    for words in _lines(log.path):
        if words[0] != name:
            if not WORD.match(words[0]):
                log.left_out["garbled lines"] += 1
            elif words[0] in POSE_LINES and not _is_pose(words):
                log.left_out_beside[f"garbled {words[0]} lines"] += 1
            continue
        try:
            line = laser_line(words)
        except (ValueError, IndexError):
            log.left_out["garbled lines"] += 1
            continue
        own = normalise_driver_ranges(line.ranges, 0.0, log.range_max)
        ranges = _at_beams_of(first, line, own, log.angles, fixed=fixed)
        if ranges is None:
            log.left_out["scans of other beams"] += 1
            continue
        fitted += ranges is not own
        stamp = round((line.ipc, line.logger)[clock] * 1e9)
        reference = None
        if true is not None:
            reference = true.at(stamp)
        elif log.reference and line.laser is not None:
            reference = se2.compose(line.laser, se2.inverse(log.mount))
        yield LoggedScan(stamp, ranges, line.robot if odom is None else odom.at(stamp), reference)
    log.note_fitted(fitted)


def _at_beams_of(first: LaserLine, line: LaserLine, ranges: Array, angles: Array, *, fixed: bool) -> Array | None:
    """The line's ``ranges`` at the first line's ``angles``: an interlaced LMS turns its beams by 0.25 deg each scan.

    Returns None where the line cannot be brought to them; with ``fixed`` only a line of the same beams can.
    """
    if line.beams == first.beams and len(ranges) == len(angles):
        return ranges
    if fixed or line.beams is None or first.beams is None or line.beams.range_max != first.beams.range_max:
        return None
    return resampled(ranges, line.beams.angles(), angles)


def _is_pose(words: list[str]) -> bool:
    try:
        pose_line(words)
    except (ValueError, IndexError):
        return False
    return True


def _lines(path: Path) -> Iterator[list[str]]:
    """The words of each line that has any, less comments; UserError where the file cannot be read to its end."""
    try:
        with path.open("rb") as raw, unpacked(raw) as stream:
            while line := stream.readline(LONGEST):
                words = line.decode("ascii", "replace").split()
                if words and not words[0].startswith("#"):
                    yield words
    except BROKEN as error:
        raise UserError(
            f"{path}: cut short or damaged ({error}); copy or download it again, or unpack what is intact and use that"
        ) from None


def unpacked(raw: BinaryIO) -> BinaryIO:
    """What is inside a .gz, .bz2 or .xz, told by its first bytes; else the file itself."""
    magic = raw.read(6)
    raw.seek(0)
    if magic.startswith(b"\x1f\x8b"):
        return gzip.open(raw)  # type: ignore[return-value]
    if magic.startswith(b"BZh"):
        return bz2.open(raw)  # type: ignore[return-value]
    if magic == b"\xfd7zXZ\x00":
        return lzma.open(raw)  # type: ignore[return-value]
    return raw
