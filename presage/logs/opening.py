"""Recognises the format from the content."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Literal

from mcap.exceptions import McapError
from mcap.reader import SeekingReader

from common.errors import UserError
from presage.logs.carmen import DECOMPRESSION_ERRORS, decompressed, open_carmen
from presage.logs.carmen_lines import is_laser
from presage.logs.log import Log, Reading
from presage.logs.npz import open_npz
from services.recorder.files.chunks import MAGIC as MCAP
from services.recorder.files.writer import PROFILE
from services.recorder.reader import read_recording

Kind = Literal["recording", "npz", "carmen", "ros1", "ros2"]
KNOWN_FORMATS = "a presage recording, a CARMEN log, a ROS 1 or 2 bag, or an .npz file of scans"
IS_A_RECORDING = "is a presage recording already: use it directly with replay, localize and other commands"
HEAD_BYTES = 1 << 16  # a CARMEN log is recognised from these first bytes
CARMEN_LINES = ("PARAM", "SYNC", "ODOM", "TRUEPOS")  # besides the lines of lasers


def kind_of(path: Path) -> Kind:
    """Recognises the format from the first bytes; raises UserError if the format is not known."""
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise UserError(f"{path}: a folder without metadata.yaml is not a ROS 2 bag; name a file in it")
        return "ros2"
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
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
        return _check_suffix(path, ".db3")
    if head.startswith(MCAP):
        return "recording" if _is_recording(path) else _check_suffix(path, ".mcap")
    _check_carmen(path, head)
    return "carmen"


def open_log(path: Path, reading: Reading) -> Log:
    """Opens a log of another program; raises UserError if it cannot be read or is a presage recording."""
    kind = kind_of(path)
    if kind == "recording":
        raise UserError(f"{path}: {IS_A_RECORDING}")
    if kind == "ros1" or kind == "ros2":  # noqa: PLR1714 - mypy narrows the type only this way
        from presage.logs.rosbag import open_rosbag  # rosbags takes a moment to import

        return open_rosbag(path, kind, reading)
    log = open_npz(path, reading) if kind == "npz" else open_carmen(path, reading)
    return with_reversed_beams(log) if reading.upside_down else log


def with_reversed_beams(log: Log) -> Log:
    """Returns the log of a scanner that is mounted upside down, with the beams of each scan in reverse order."""
    # The list is shared with the returned log, so that notes made while reading appear in both.
    log.notes.append("the scanner is mounted upside down: the order of its beams is reversed")
    return replace(log, angles=-log.angles[::-1], read=lambda: (replace(s, ranges=s.ranges[::-1]) for s in log.read()))


def _is_recording(path: Path) -> bool:
    """Whether an MCAP file is a presage recording, by the profile in its header, else by its topics."""
    try:
        with path.open("rb") as stream:
            profile = SeekingReader(stream, record_size_limit=HEAD_BYTES).get_header().profile
    except (McapError, struct.error, UnicodeDecodeError):  # damaged
        profile = ""
    return profile == PROFILE or (not profile and bool(read_recording(path).topics()))


def _check_suffix(path: Path, suffix: str) -> Kind:
    if path.suffix != suffix:  # rosbags recognises the storage from the suffix
        raise UserError(f"{path}: is a ROS 2 bag with another suffix: rename it to NAME{suffix}")
    return "ros2"


def _check_carmen(path: Path, head: bytes) -> None:
    """Raises UserError unless the file is a CARMEN log, possibly compressed."""
    if head.startswith(b"#ROSBAG V1"):
        raise UserError(f"{path}: a bag of ROS before 2010: convert it with `rosbag fix` of ROS 1")
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        raise UserError(f"{path}: one file of a compressed ROS 2 bag: name its folder, or unpack it with zstd")
    try:
        # Not from `head`: a block of bzip2 (up to 900 kB) can only be decompressed as a whole.
        with path.open("rb") as raw, decompressed(raw) as stream:
            text, compressed = stream.read(HEAD_BYTES), stream is not raw
    except DECOMPRESSION_ERRORS as error:
        raise UserError(f"{path}: cut short or damaged ({error}); copy or download it again") from None
    if _is_carmen(text):
        return
    if compressed:
        raise UserError(f"{path}: compressed, and no CARMEN log is inside: unpack it first")
    raise UserError(f"{path}: not {KNOWN_FORMATS} (it begins with {head[:8]!r})")


def _is_carmen(text: bytes) -> bool:
    """Whether the text contains a line of a CARMEN log and no binary data."""
    if b"\x00" in text:
        return False
    words = [line.split(None, 1)[0].decode("ascii", "replace") for line in text.splitlines() if line.split()]
    return any(is_laser(word) or word in CARMEN_LINES for word in words)
