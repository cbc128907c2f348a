"""Chooses one robot and the output names."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.progress import track

from common.errors import UserError
from common.messages.definitions import Stamped
from common.messages.topics import Topic
from services.recorder.reader import RawMessage, Recording

Entry = tuple[Topic, Stamped, RawMessage]


def robots_of(recording: Recording) -> list[str]:
    """Names of the robots with messages in the recording."""
    return sorted({key.split("/")[1] for key in recording.topics()})


def robot_of(recording: Recording, wanted: str = "") -> str:
    """The robot ``wanted``, or if that is empty, the robot of the recording; raises UserError if it is not in there."""
    robots = robots_of(recording)
    if wanted and wanted not in robots:
        raise UserError(f"{recording.path}: no robot {wanted!r} in it; it has {', '.join(robots) or 'none'}")
    recorded = recording.metadata.get("presage", {}).get("robot", "")
    return wanted or (recorded if recorded in robots or not robots else robots[0])


def keys_of(recording: Recording, robot: str, *topics: Topic) -> dict[str, Topic]:
    """The keys of one robot with their topics; ``topics`` defaults to all."""
    keys = recording.topics().items()
    return {key: topic for key, topic in keys if key.split("/")[1] == robot and (not topics or topic in topics)}


def entries(recording: Recording, robot: str, *topics: Topic) -> Iterator[Entry]:
    """Yields the decoded messages of one robot in the order of reception; ``topics`` defaults to all."""
    for topic, message, raw in recording.messages(*topics):
        if raw.key.split("/")[1] == robot:
            yield topic, message, raw


def with_progress(items: Iterator[Entry], total: int, what: str, console: Console) -> Iterator[Entry]:
    """Yields the items and shows a progress bar if the console is a terminal."""
    yield from track(items, what, total=total, console=console, transient=True, disable=not console.is_terminal)


def stem_of(recording: Path) -> str:
    """The name of a recording without .mcap, .mcap.active or .mcap.incomplete."""
    return recording.name.split(".mcap")[0]


def refuse_to_overwrite(paths: list[Path], *, force: bool) -> None:
    """Raises UserError if one of the paths exists, unless ``force``."""
    for path in paths:
        if path.exists() and not force:
            raise UserError(f"{path}: exists already; choose another place with --out, or overwrite it with --force")
