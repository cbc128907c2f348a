"""Chooses one robot and the output names."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.progress import track

from common.errors import UserError
from common.messages.definitions import Stamped
from common.messages.topics import Topic
from services.recorder.reader import Raw, Recording

Entry = tuple[Topic, Stamped, Raw]


def robots_of(recording: Recording) -> list[str]:
    """Names of the robots that have messages in it."""
    return sorted({key.split("/")[1] for key in recording.topics()})


def robot_of(recording: Recording, wanted: str) -> str:
    """The robot asked for, or the one the recording was made of; raises UserError where it has no such robot."""
    there = robots_of(recording)
    if wanted and wanted not in there:
        raise UserError(f"{recording.path}: no robot {wanted!r} in it; it has {', '.join(there) or 'none'}")
    of_file = recording.metadata.get("presage", {}).get("robot", "")
    return wanted or (of_file if of_file in there or not there else there[0])


def keys_of(recording: Recording, robot: str, *topics: Topic) -> dict[str, Topic]:
    """Keys of one robot with their rows; of some topics (none: all)."""
    found = recording.topics().items()
    return {key: row for key, row in found if key.split("/")[1] == robot and (not topics or row in topics)}


def entries(recording: Recording, robot: str, *topics: Topic) -> Iterator[Entry]:
    """Decoded messages of one robot, in the order received."""
    for topic, message, raw in recording.messages(*topics):
        if raw.key.split("/")[1] == robot:
            yield topic, message, raw


def tracked(found: Iterator[Entry], total: int, what: str, console: Console) -> Iterator[Entry]:
    """The same, with a progress bar on a terminal."""
    yield from track(found, what, total=total, console=console, transient=True, disable=not console.is_terminal)


def stem_of(recording: Path) -> str:
    """A recording's name without .mcap, .mcap.active, .mcap.torn."""
    return recording.name.split(".mcap")[0]


def refuse_to_overwrite(paths: list[Path], *, force: bool) -> None:
    """Raises UserError for the first that is there already."""
    for path in paths:
        if path.exists() and not force:
            raise UserError(f"{path}: is there already; choose another place with --out, or write over it with --force")
