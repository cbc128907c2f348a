"""Recognises the format from the content."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from common.errors import UserError
from presage.logs.carmen import BROKEN, open_carmen, unpacked
from presage.logs.carmen_lines import is_laser
from presage.logs.log import Log, Reading
from presage.logs.npz import open_npz
from services.recorder.files.chunks import MAGIC as MCAP
from services.recorder.files.writer import PROFILE
from services.recorder.reader import read_recording

Kind = Literal["recording", "npz", "carmen", "ros1", "ros2"]
KNOWN = "a presage recording, a CARMEN log, a ROS 1 or 2 bag, or an .npz of scans"
RECORDING = "is a presage recording already: replay, localize and the others take it as it is"
PEEK = 1 << 16  # bytes in which a CARMEN log must show itself
CARMEN = ("PARAM", "SYNC", "ODOM", "TRUEPOS", "#")


def kind_of(path: Path) -> Kind:
    """Told by the first bytes; raises UserError where it is none of them."""
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise UserError(f"{path}: a folder without metadata.yaml is no ROS 2 bag; name a file in it")
        return "ros2"
    try:
        with path.open("rb") as stream:
            head = stream.read(PEEK)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    if not head:
        raise UserError(f"{path}: is empty")
    if head.startswith(b"PK"):
        return "npz"
    if head.startswith(b"#ROSBAG V2.0"):
        return "ros1"
    if head.startswith(b"SQLite format 3\x00"):
        return _named(path, ".db3")
    if head.startswith(MCAP):
        return "recording" if _is_ours(path, head) else _named(path, ".mcap")
    _refuse_others(path, head)
    return "carmen"


def open_log(path: Path, reading: Reading) -> Log:
    """A log of another program; raises UserError saying what is wrong, also where it is a recording of presage."""
    kind = kind_of(path)
    if kind == "recording":
        raise UserError(f"{path}: {RECORDING}")
    if kind == "ros1" or kind == "ros2":  # noqa: PLR1714 - mypy follows
        try:
            from presage.logs.rosbag import open_rosbag  # noqa: PLC0415 - its types take a moment
        except ModuleNotFoundError as error:
            raise UserError(f"{path}: ROS bags need the package {error.name}: pip install 'presage[logs]'") from None

        return open_rosbag(path, kind, reading)
    log = open_npz(path, reading) if kind == "npz" else open_carmen(path, reading)
    return turned_over(log) if reading.upside_down else log


def turned_over(log: Log) -> Log:
    """Of a scanner that hangs upside down: what is on its left is on the robot's right."""
    log.notes.append("the scanner hangs upside down: its beams are turned over")  # to this list reading adds its own
    return replace(log, angles=-log.angles[::-1], read=lambda: (replace(s, ranges=s.ranges[::-1]) for s in log.read()))


def _is_ours(path: Path, head: bytes) -> bool:
    """An MCAP file of the recorder, by the profile in its header; where none is named, by its topics."""
    # magic, opcode 1, length u64, then the profile as u32 length and text: https://mcap.dev/spec
    start = len(MCAP) + 9
    length = int.from_bytes(head[start : start + 4], "little")
    profile = head[start + 4 : start + 4 + length]
    return profile == PROFILE.encode() or (not profile and bool(read_recording(path).topics()))


def _named(path: Path, suffix: str) -> Kind:
    if path.suffix != suffix:
        raise UserError(f"{path}: is a ROS 2 bag under another name: rename it to NAME{suffix}")
    return "ros2"


def _refuse_others(path: Path, head: bytes) -> None:
    """Raises UserError unless it is a CARMEN log, perhaps compressed."""
    if head.startswith(b"#ROSBAG V1"):
        raise UserError(f"{path}: a bag of ROS before 2010: `rosbag fix` of ROS 1 makes one that can be read")
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        raise UserError(f"{path}: one file of a compressed ROS 2 bag: name its folder, or unpack it with zstd")
    try:
        # From the file, not from its head: a block of bzip2 (up to 900 kB) unpacks only as a whole.
        with path.open("rb") as raw, unpacked(raw) as stream:
            text, compressed = stream.read(PEEK), stream is not raw
    except BROKEN as error:
        raise UserError(f"{path}: cut short or damaged ({error}); copy or download it again") from None
    if _is_carmen(text):
        return
    if compressed:
        raise UserError(f"{path}: compressed, and no CARMEN log is inside: unpack it first")
    raise UserError(f"{path}: not {KNOWN} (it begins with {head[:8]!r})")


def _is_carmen(text: bytes) -> bool:
    """Whether one of the first lines is one of CARMEN's, and nothing is binary."""
    if b"\x00" in text:
        return False
    words = [line.split(None, 1)[0].decode("ascii", "replace") for line in text.splitlines() if line.split()]
    return any(is_laser(word) or word in CARMEN[:-1] for word in words)
