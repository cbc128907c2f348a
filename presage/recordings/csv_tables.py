"""CSV export, one file for each topic."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TextIO, Union, get_args, get_origin

import numpy as np
from rich.console import Console

from common.errors import UserError
from common.messages.reference import comments
from common.messages.topics import Topic
from common.messages.wire import Binary, Message
from common.writing import complete_files
from presage.recordings.selection import entries, keys_of, refuse_to_overwrite, robot_of, with_progress
from presage.terminal.output import make_folder
from services.recorder.reader import Recording

README = "README.md"
MAX_OPEN_FILES = 100  # an array of variable length has a file for each length, and a process may open about 1000
TIMES = {
    "log_time_ns": "reception by the recorder, ns of wall time",
    "publish_time_ns": "publication, ns of wall time",
}
AXES = ("x", "y", "yaw")
# Column suffixes and indices of the six independent elements of a symmetric 3 x 3 matrix.
MATRIX = {f".{AXES[i]}_{AXES[j]}": (i, j) for i in range(3) for j in range(i, 3)}
VECTORS = {"xi", "protection"}  # array fields with three elements
Value = str | int | float | bool | None


@dataclass(frozen=True)
class Column:
    """A column of a table: its name, how its value is read from a message, and its meaning."""

    name: str
    read: Callable[[Any], Value]
    meaning: str


def columns_of(model: type[Message], prefix: str = "", read: Callable[[Any], Any] | None = None) -> list[Column]:
    """Columns for the scalars of a message type, nested ones as `pose.x`, and for arrays of fixed length.

    Leaves out arrays of variable length, lists and dictionaries.
    """
    found: list[Column] = []
    parent: Callable[[Any], Any] = read or (lambda message: message)
    for name, kind, about in fields_of(model):
        get = partial(_field, parent, name)
        label = prefix + name
        if isinstance(kind, Binary):
            elements = MATRIX if kind.row == (3,) else {f".{axis}": (i,) for i, axis in enumerate(AXES)}
            if kind.row == (3,) or name in VECTORS:
                found += [
                    Column(label + suffix, partial(_element, get, index), about) for suffix, index in elements.items()
                ]
        elif isinstance(kind, type) and issubclass(kind, Message):
            inner = columns_of(kind, label + ".", get)
            found += [Column(c.name, c.read, "; ".join(filter(None, (c.meaning, about)))) for c in inner]
        elif get_origin(kind) not in {list, dict}:
            found.append(Column(label, get, about))
    return found


def fields_of(model: type[Message]) -> Iterator[tuple[str, Any, str]]:
    """Yields name, type and meaning of each field; the type is a `Binary`, a message, a container or a plain type."""
    about = comments(model)
    for name, info in model.model_fields.items():
        parts = [info.annotation]
        if get_origin(info.annotation) in {Union, UnionType}:
            parts = [part for part in get_args(info.annotation) if part is not NoneType]
        binary = [m for m in (*info.metadata, *get_args(parts[0])) if isinstance(m, Binary)]
        yield name, binary[0] if binary else parts[0], about.get(name, "")


def _field(parent: Callable[[Any], Any], name: str, message: Any) -> Any:
    """The field ``name`` of ``parent(message)``; None if the parent is None."""
    return None if (part := parent(message)) is None else getattr(part, name)


def _element(get: Callable[[Any], Any], index: tuple[int, ...], message: Any) -> Value:
    """An element of an array field; None if the array has another shape."""
    array = get(message)
    try:
        return None if array is None else float(array[index])
    except IndexError:
        return None


class CsvTables:
    """The CSV files in a folder; each is created when its first row comes."""

    def __init__(self, folder: Path) -> None:
        """The files are written into ``folder``."""
        self.folder, self.rows = folder, dict[str, int]()  # number of rows by file name
        self._open: dict[str, TextIO] = {}  # by file name, the one opened first comes first

    def close(self) -> None:
        """Closes all files."""
        for stream in self._open.values():
            stream.close()

    def add(self, name: str, header: list[str], row: list[Value]) -> None:
        """Adds a row to NAME.csv; None becomes an empty cell, and booleans become true and false."""
        path = self.folder / f"{name}.csv"
        if path.name not in self.rows:
            path.write_text(",".join(header) + "\n", encoding="utf-8")
            self.rows[path.name] = 0
        if path.name not in self._open:
            if len(self._open) >= MAX_OPEN_FILES:
                self._open.pop(next(iter(self._open))).close()
            self._open[path.name] = path.open("a", newline="", encoding="utf-8")
        cells = [str(cell).lower() if isinstance(cell, bool) else cell for cell in row]
        csv.writer(self._open[path.name], lineterminator="\n").writerow(cells)
        self.rows[path.name] += 1


class _TopicLayout:
    """The tables of one topic and how messages become rows of them."""

    def __init__(self, topic: Topic) -> None:
        self.name, self.columns = topic.name, columns_of(topic.message)
        fields = list(fields_of(topic.message))
        kinds = [(name, kind) for name, kind, _ in fields]
        self.meanings = {name: meaning for name, _, meaning in fields}
        fixed = {column.name.split(".")[0] for column in self.columns}
        self.arrays = [name for name, kind in kinds if isinstance(kind, Binary) and name not in fixed]
        self.lists = {name: columns_of(get_args(kind)[0]) for name, kind in kinds if get_origin(kind) is list}
        self.maps = [name for name, kind in kinds if get_origin(kind) is dict]

    def write(self, tables: CsvTables, message: Any, times: list[Value], *, arrays: bool) -> None:
        """Adds the rows of one message."""
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
            # The length is part of the file's name, so that all rows of a file have the same length.
            tables.add(f"{self.name}.{name}-{len(values)}", head, [*key, *values.tolist()])


def export_csv(
    recording: Recording, folder: Path, robot: str, console: Console, *, arrays: bool, force: bool
) -> dict[str, int]:
    """Writes one file for each topic into ``folder``, with a README of columns and units.

    Returns the number of rows by file name. Raises UserError if nothing can be written, or if the folder is not empty
    and ``force`` is not given.
    """
    make_folder(folder)
    refuse_to_overwrite(sorted(folder.iterdir())[:1], force=force)
    name = robot_of(recording, robot)
    keys = keys_of(recording, name)
    if not keys:
        raise UserError(f"{recording.path}: no message of presage in it, so there is nothing to export")
    layouts = {topic.name: _TopicLayout(topic) for topic in dict.fromkeys(keys.values())}
    counts = recording.counts
    with complete_files(folder, folder) as new:
        with closing(CsvTables(new)) as tables:
            messages = with_progress(entries(recording, name), sum(counts[key] for key in keys), "csv", console)
            for topic, message, raw in messages:
                layouts[topic.name].write(tables, message, [raw.logged_ns, raw.published_ns], arrays=arrays)
        (new / README).write_text(_readme(recording, name, layouts, tables.rows, arrays=arrays), encoding="utf-8")
    return tables.rows


def _readme(
    recording: Recording, robot: str, layouts: dict[str, _TopicLayout], rows: dict[str, int], *, arrays: bool
) -> str:
    """Text of the README: the meaning of all columns."""
    lines = [
        f"# {recording.path.name}, robot {robot}",
        "",
        "Written by `presage export --format csv`. Units are SI; poses are of base_link in map unless noted otherwise.",
        "An empty cell means unknown. Ranges: inf is no return, -inf too close (REP-117), 0 not measured.",
        "`stamp_ns` is simulation or sensor time; `log_time_ns` and `publish_time_ns` are wall time.",
        "Lists have their own files (TOPIC.FIELD.csv), whose rows belong to the message with the same `log_time_ns`",
        "and `seq`. So have arrays (TOPIC.FIELD-N.csv, with N columns), "
        + ("which are all here." if arrays else "which `presage export --format csv --arrays` writes."),
    ]
    for layout in layouts.values():
        lines += ["", f"## {layout.name}.csv ({rows.get(f'{layout.name}.csv', 0)} rows)", ""]
        table = [*TIMES.items(), *((column.name, column.meaning) for column in layout.columns)]
        lines += ["| column | meaning |", "|---|---|", *(_table_row(f"`{name}`", text) for name, text in table)]
        for name, columns in layout.lists.items():
            file = f"`{layout.name}.{name}.csv`"
            lines += [_table_row(f"{file}: `{column.name}`", column.meaning) for column in columns]
        for name in layout.maps:
            lines.append(_table_row(f"`{layout.name}.{name}.csv`: `name`, `value`", layout.meanings[name]))
        for name in layout.arrays:
            file = f"`{layout.name}.{name}-N.csv`" + ("" if arrays else ", with `--arrays`")
            lines.append(_table_row(file, layout.meanings[name]))
    return "\n".join(lines) + "\n"


def _table_row(name: str, meaning: str) -> str:
    """A row of a Markdown table."""
    escaped = meaning.replace("|", "\\|")
    return f"| {name} | {escaped} |"
