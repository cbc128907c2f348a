"""Prints `info` and `echo`."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Collection
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from common.bus.bus import Link
from common.errors import UserError
from common.messages.topics import TOPICS, topic_of
from common.messages.wire import DecodeError
from presage.live.commands import echo, to_plain_values, topic_named
from presage.recordings.info import RecordingFacts, collect_facts
from presage.terminal.output import check_file, write_json
from services.recorder.reader import Recording, read_recording

MAX_LISTED_VALUES = 6  # of a metadata record; of a longer one, only their number is printed


def info(file: Path, json_file: Path | None, check: bool | None, console: Console) -> int:
    """Prints facts about a recording; returns 1 if it is incomplete or messages are missing, else 0."""
    check_file(json_file, "--json")
    recording = read_recording(file)
    with console.status("reading"):
        facts = collect_facts(recording, check)
    _print_head(facts, recording, console)
    console.print(_table(facts))
    if facts.dropped_by_services:
        parts = []
        for name, count in facts.dropped_by_services.items():
            service, key = name.split(" ")[:2]
            parts.append(f"{count} of {key} by {service}")
        console.print(f"dropped by services, which use the newest message: {'; '.join(parts)}", highlight=False)
    for name, keys in facts.metadata.items():
        values = f"{len(keys)} values" if len(keys) > MAX_LISTED_VALUES else ", ".join(keys) or "empty"
        console.print(f"metadata    {escape(name)}: {escape(values)}", highlight=False, soft_wrap=True)
    for name, size in facts.attachments.items():
        console.print(f"attachment  {escape(name)}: {_size(size)}", highlight=False)
    if not facts.checked:
        console.print("use --check to count gaps and bytes from the messages themselves", style="dim")
    write_json(json_file, facts.as_dict())
    return 0 if facts.complete and not facts.missing else 1


def _print_head(facts: RecordingFacts, recording: Recording, console: Console) -> None:
    state = f"readable, but {facts.missing} messages are missing" if facts.missing else "complete"
    state += ", all checksums are correct" if facts.checked else ", according to its index"
    if (recovered := recording.metadata.get("recovered")) is not None:
        state += f", recovered from {recovered.get('from', 'another file')}"
    about = recording.metadata.get("presage", {})
    rows = [
        ("file", f"{facts.file}, {_size(facts.file_bytes)}"),
        ("state", state if facts.complete else "INCOMPLETE"),
        ("start", f"{facts.started}, {facts.duration_s:.2f} s, {facts.messages} messages"),
        ("robot", ", ".join(facts.robots) or "unknown"),
        ("world", facts.world or "not recorded"),
        ("scanner", str(recording.scanner() or "not recorded")),
        ("command", about.get("command", "unknown")),
        ("versions", ", ".join(f"{name} {text}" for name, text in facts.versions.items()) or "unknown"),
    ]
    for name, text in rows:
        console.print(f"{name:9} {escape(text)}", highlight=False, soft_wrap=True)
    if facts.warning:
        console.print(escape(facts.warning), style="yellow", highlight=False, soft_wrap=True)


def _table(facts: RecordingFacts) -> Table:
    table = Table()
    table.add_column("key", no_wrap=True)
    columns = ("messages", "Hz", "bytes", "gaps", "missing", "restarts", "dropped", "undecodable")
    for name in columns:
        table.add_column(name, justify="right")
    for row in facts.topics:
        numbers = (row.gaps, row.missing, row.restarts, row.dropped, row.undecodable)
        table.add_row(
            escape(row.key),
            str(row.messages),
            "-" if row.rate_hz is None else f"{row.rate_hz:.2f}",
            "-" if row.bytes is None else _size(row.bytes),
            *("-" if number is None else str(number) for number in numbers),
        )
    return table


def _size(count: int) -> str:
    """A number of bytes with a suitable unit."""
    if count < 1000:
        return f"{count} B"
    return f"{count / 1000:.1f} kB" if count < 1_000_000 else f"{count / 1e6:.1f} MB"


def echo_either(
    link: Callable[[], Link],
    source: str,
    topic: str | None,
    count: int,
    start_s: float,
    console: Console,
    *,
    full: bool,
) -> int:
    """Prints messages of a topic on the bus, or of a recording; raises UserError if ``source`` is neither."""
    is_file = source.endswith((".mcap", ".mcap.active")) or Path(source).exists()
    if source not in {row.name for row in TOPICS} and is_file:
        return echo_file(Path(source), topic, count, start_s, console, full=full)
    if topic is not None or start_s:
        topic_named(source)
        raise UserError(f"{source} is a topic on the bus: a second topic and --start are for recordings")
    return echo(link(), source, count, console, full=full)


def echo_file(file: Path, name: str | None, count: int, start_s: float, console: Console, *, full: bool) -> int:
    """Prints messages of a recording as JSON lines with key and time; returns 1 if there is none, else 0."""
    recording = read_recording(file)
    keys = _keys(recording, name)
    printed, from_ns = 0, recording.start_ns + round(start_s * 1e9)
    for raw in recording.payloads(keys, start_ns=from_ns):
        topic = topic_of(raw.key)
        head = {"key": raw.key, "time_s": round((raw.logged_ns - recording.start_ns) * 1e-9, 6)}
        try:
            rest = (
                to_plain_values(topic.message.decode(raw.payload), full=full) if topic else {"bytes": len(raw.payload)}
            )
        except DecodeError as error:
            rest = {"undecodable": str(error), "bytes": len(raw.payload)}
        line = json.dumps({**head, **rest})
        console.print(line, markup=False, highlight=False, soft_wrap=True)
        printed += 1
        if printed == count:
            break
    if recording.warning:
        print(f"warning: {recording.warning}", file=sys.stderr)
    return 0 if printed else 1


def _keys(recording: Recording, name: str | None) -> Collection[str] | None:
    """Keys of the topic or key ``name``, None for all; raises UserError if the recording has none of them."""
    if name is None:
        return None
    if name in recording.counts:
        return [name]
    keys = [key for key, topic in recording.topics().items() if topic == topic_named(name)]
    if not keys:
        topics = [topic.name for topic in TOPICS if topic in recording.topics().values()]
        raise UserError(f"{recording.path}: no {name} in it; it has {', '.join(topics) or 'no topic of presage'}")
    return keys
