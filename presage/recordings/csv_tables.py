"""CSV, one file for each topic."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np
from rich.console import Console

from common.errors import UserError
from common.messages.reference import comments
from common.messages.topics import Topic
from common.messages.wire import Binary, Message
from presage.recordings.selection import entries, keys_of, refuse_to_overwrite, robot_of, tracked
from presage.terminal.output import make_folder
from services.recorder.reader import Recording

README = "README.md"
TIMES = {"log_time_ns": "received by the recorder, wall clock", "publish_time_ns": "sent, wall clock"}
AXES = ("x", "y", "yaw")
# Names of a 3 x 3 matrix' six numbers (it is symmetric) and of a vector's three.
MATRIX = {f".{AXES[i]}_{AXES[j]}": (i, j) for i in range(3) for j in range(i, 3)}
VECTORS = {"xi"}  # arrays of a length that the message fixes: three
Value = str | int | float | bool | None


@dataclass(frozen=True)
class Column:
    """One column: how it is read from a message, and what it means."""

    name: str
    read: Callable[[Any], Value]
    meaning: str


def columns_of(model: type[Message], prefix: str = "", read: Callable[[Any], Any] | None = None) -> list[Column]:
    """Scalars of a message, nested ones as `pose.x`; arrays of free length and lists are left to others."""
    found: list[Column] = []
    of: Callable[[Any], Any] = read or (lambda message: message)
    for name, kind, about in fields_of(model):
        get = partial(_field, of, name)
        label = prefix + name
        if isinstance(kind, Binary):
            fixed = MATRIX if kind.row == (3,) else {f".{axis}": (i,) for i, axis in enumerate(AXES)}
            if kind.row == (3,) or name in VECTORS:
                found += [Column(label + end, partial(_element, get, at), about) for end, at in fixed.items()]
        elif isinstance(kind, type) and issubclass(kind, Message):
            inner = columns_of(kind, label + ".", get)
            found += [Column(c.name, c.read, "; ".join(filter(None, (c.meaning, about)))) for c in inner]
        elif get_origin(kind) not in {list, dict}:
            found.append(Column(label, get, about))
    return found


def fields_of(model: type[Message]) -> Iterator[tuple[str, Any, str]]:
    """Name, kind and meaning of each field: a `Binary`, a message, a container of one, or a plain type."""
    about = comments(model)
    for name, info in model.model_fields.items():
        parts = [info.annotation]
        if get_origin(info.annotation) in {Union, UnionType}:
            parts = [part for part in get_args(info.annotation) if part is not NoneType]
        binary = [m for m in (*info.metadata, *get_args(parts[0])) if isinstance(m, Binary)]
        yield name, binary[0] if binary else parts[0], about.get(name, "")


def _field(of: Callable[[Any], Any], name: str, message: Any) -> Any:
    """A field of what ``of`` finds in a message; None within what is None."""
    return None if (part := of(message)) is None else getattr(part, name)


def _element(get: Callable[[Any], Any], at: tuple[int, ...], message: Any) -> Value:
    """An element of an array field; None where the array is of another shape."""
    array = get(message)
    try:
        return None if array is None else float(array[at])
    except IndexError:
        return None


class Tables:
    """The CSV files of a folder, opened when their first row comes."""

    def __init__(self, folder: Path, stack: ExitStack, *, force: bool) -> None:
        """Into ``folder``; ``stack`` closes the files."""
        self.folder, self.rows = folder, dict[str, int]()  # rows by file name
        self._stack, self._force = stack, force
        self._writers: dict[str, Any] = {}

    def add(self, name: str, header: list[str], row: list[Value]) -> None:
        """One row of NAME.csv; None is an empty cell, true and false are words."""
        writer = self._writers.get(name)
        if writer is None:
            path = self.folder / f"{name}.csv"
            refuse_to_overwrite([path], force=self._force)
            stream = self._stack.enter_context(path.open("w", newline="", encoding="utf-8"))
            writer = self._writers[name] = csv.writer(stream, lineterminator="\n")
            writer.writerow(header)
            self.rows[path.name] = 0
        writer.writerow([str(cell).lower() if isinstance(cell, bool) else cell for cell in row])
        self.rows[f"{name}.csv"] += 1


class _Layout:
    """How messages of one topic become rows."""

    def __init__(self, topic: Topic) -> None:
        self.name, self.columns = topic.name, columns_of(topic.message)
        kinds = [(name, kind) for name, kind, _ in fields_of(topic.message)]
        fixed = {column.name.split(".")[0] for column in self.columns}
        self.arrays = [name for name, kind in kinds if isinstance(kind, Binary) and name not in fixed]
        self.lists = {name: columns_of(get_args(kind)[0]) for name, kind in kinds if get_origin(kind) is list}
        self.maps = [name for name, kind in kinds if get_origin(kind) is dict]

    def write(self, tables: Tables, message: Any, times: list[Value], *, arrays: bool) -> None:
        """Rows of one message."""
        header = [*TIMES, *(column.name for column in self.columns)]
        tables.add(self.name, header, [*times, *(column.read(message) for column in self.columns)])
        key: list[Value] = [times[0], message.stamp_ns, message.seq]
        names = ["log_time_ns", "stamp_ns", "seq"]
        for name, columns in self.lists.items():
            head = [*names, "index", *(column.name for column in columns)]
            for index, item in enumerate(getattr(message, name)):
                tables.add(f"{self.name}.{name}", head, [*key, index, *(c.read(item) for c in columns)])
        for name in self.maps:
            for label, value in getattr(message, name).items():
                tables.add(f"{self.name}.{name}", [*names, "name", "value"], [*key, label, value])
        for name in self.arrays if arrays else ():
            values = np.asarray(getattr(message, name), float).ravel()
            if not len(values):
                continue
            head = [*names, *map(str, range(len(values)))]
            # The length is in the file's name, so that no file is ragged.
            tables.add(f"{self.name}.{name}-{len(values)}", head, [*key, *values.tolist()])


def export_csv(
    recording: Recording, folder: Path, robot: str, console: Console, *, arrays: bool, force: bool
) -> dict[str, int]:
    """One file a topic into ``folder``, with a README of columns and units: rows by file name.

    Raises UserError where it cannot be written, or something is there already and ``force`` is not given.
    """
    make_folder(folder, "--out")
    refuse_to_overwrite(sorted(folder.iterdir())[:1], force=force)
    name = robot_of(recording, robot)
    keys = keys_of(recording, name)
    if not keys:
        raise UserError(f"{recording.path}: no message of presage in it, so there is nothing to export")
    layouts = {topic.name: _Layout(topic) for topic in dict.fromkeys(keys.values())}
    counts = recording.counts()
    with ExitStack() as stack:
        tables = Tables(folder, stack, force=force)
        found = tracked(entries(recording, name), sum(counts[key] for key in keys), "csv", console)
        for topic, message, raw in found:
            layouts[topic.name].write(tables, message, [raw.logged_ns, raw.published_ns], arrays=arrays)
    (folder / README).write_text(_readme(recording, name, layouts, tables.rows), encoding="utf-8")
    return tables.rows


def _readme(recording: Recording, robot: str, layouts: dict[str, _Layout], rows: dict[str, int]) -> str:
    """What the columns mean."""
    lines = [
        f"# {recording.path.name}, robot {robot}", "",
        "Written by `presage export --format csv`. Units are SI; poses are of base_link in map unless said otherwise.",
        "Empty: not stated. inf: no return, -inf: too close (REP-117); a scan's 0: not measured.",
        "`stamp_ns` is simulation or sensor time;",
        "`log_time_ns` and `publish_time_ns` are the wall clock's. Lists and arrays stand in files of their own",
        "(TOPIC.FIELD.csv; -N is the number of columns of an array), tied to the message by `log_time_ns` and `seq`.",
    ]  # fmt: skip
    for layout in layouts.values():
        lines += ["", f"## {layout.name}.csv ({rows.get(f'{layout.name}.csv', 0)} rows)", ""]
        lines += ["| column | meaning |", "|---|---|"]
        lines += [f"| `{name}` | {text} |" for name, text in TIMES.items()]
        lines += [f"| `{column.name}` | {column.meaning} |" for column in layout.columns]
        for name, columns in layout.lists.items():
            lines += [f"| `{layout.name}.{name}.csv`: `{column.name}` | {column.meaning} |" for column in columns]
    return "\n".join(lines) + "\n"
