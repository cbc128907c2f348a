"""References as text files: rows of plain values with rounded numbers; long arrays as a few statistics and samples.

Rows are compared field by field. States, counts and text must be equal. Numbers may differ by `tolerance`, because
processors differ in the order of sums and in the rounding of functions such as the sine.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]

FOLDER = Path(__file__).resolve().parent / "references"
DIGITS = 7  # significant digits of numbers in a file
SAMPLES = 6  # stored values of a long array
MAX_SHOWN_DIFFERENCES = 6
MISSING = "nothing"
# Absolute and relative tolerance by the last name in a field's path that is listed here, otherwise of "". Run without
# AVX and FMA, with another BLAS kernel and two threads, the same code gave differences of 6e-7 (relative) and 3e-7 m in
# the network of preset paper (float32), and of 1e-15 elsewhere; ten times that is allowed. xi is a difference of large
# numbers.
TOLERANCES = {"": (1e-6, 5e-6), "xi": (1e-2, 1e-5)}


@dataclass(frozen=True)
class Difference:
    """A field of a message that differs from the reference."""

    number: int  # of the row in the reference, from 0; for a new message its own number
    message: str  # kind and stamp
    field: str  # path of the field; empty for the whole message
    expected: Any
    got: Any

    def __str__(self) -> str:
        where = f"message {self.number} ({self.message})"
        if not self.field:
            return f"{where}: " + ("missing" if self.got is MISSING else "new, the reference has none")
        text = f"{where}: {self.field}: expected {_short(self.expected)}, got {_short(self.got)}"
        if _is_number(self.expected) and _is_number(self.got):
            allowed = tolerance(self.field, self.expected)
            text += f" (off by {abs(self.got - self.expected):.3g}, allowed {allowed:.2g})"
        return text


def of_array(values: np.ndarray) -> Row:
    """A few statistics and samples of a long array (N,)."""
    finite = values[np.isfinite(values)]
    row: Row = {"count": len(values), "inf": int(np.isposinf(values).sum()), "-inf": int(np.isneginf(values).sum())}
    if len(finite):
        row |= {"mean": finite.mean(), "std": finite.std(), "min": finite.min(), "max": finite.max()}
    step = -(-len(values) // SAMPLES)
    return {k: float(v) if isinstance(v, np.floating) else v for k, v in row.items()} | {
        f"every {step}": values[::step].tolist()
    }


def of_symmetric(matrix: np.ndarray) -> Row:
    """A covariance or curvature (3, 3) as the roots of its diagonal and its correlations."""
    root = np.sqrt(np.abs(np.diag(matrix)))
    scale = np.where(root > 0, root, 1.0)
    scaled = matrix / np.outer(scale, scale)
    return {"root": root.tolist(), "correlation": scaled[np.triu_indices(3, 1)].tolist()}


def tolerance(field: str, expected: float) -> float:
    """How much a number may differ from the reference."""
    names = [part.partition("[")[0] for part in field.split(".")]
    absolute, relative = next((TOLERANCES[name] for name in reversed(names) if name in TOLERANCES), TOLERANCES[""])
    return absolute + relative * abs(expected)


def compare(expected: Sequence[Row], got: Sequence[Row]) -> Iterator[Difference]:
    """Yields every field that differs, and every message that is missing or new."""
    for number, old, new in _aligned(expected, got):
        if old is None or new is None:
            kind = _kind(new if old is None else old)
            yield Difference(number, kind, "", MISSING if old is None else kind, MISSING if new is None else kind)
        else:
            yield from _compare(number, _kind(old), "", old, new)


def _aligned(expected: Sequence[Row], got: Sequence[Row]) -> Iterator[tuple[int, Row | None, Row | None]]:
    """Pairs messages of the same kind and stamp. Yields number, expected and new row; None where one is missing."""
    matcher = SequenceMatcher(None, [_kind(row) for row in expected], [_kind(row) for row in got], autojunk=False)
    for what, a, after_a, b, after_b in matcher.get_opcodes():
        if what == "equal":
            yield from ((a + k, expected[a + k], got[b + k]) for k in range(after_a - a))
        else:
            yield from ((number, expected[number], None) for number in range(a, after_a))
            yield from ((number, None, got[number]) for number in range(b, after_b))


def _compare(number: int, message: str, path: str, old: Any, new: Any) -> Iterator[Difference]:
    if isinstance(old, dict) and isinstance(new, dict):
        for name in dict.fromkeys([*old, *new]):
            below = f"{path}.{name}" if path else name
            yield from _compare(number, message, below, old.get(name, MISSING), new.get(name, MISSING))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from _compare(number, message, f"{path}[{index}]", a, b)
    elif not _same(path, old, new):
        yield Difference(number, message, path, old, new)


def _same(path: str, old: Any, new: Any) -> bool:
    if _is_number(old) and _is_number(new) and (isinstance(old, float) or isinstance(new, float)):
        return old == new or (math.isfinite(old) and abs(old - new) <= tolerance(path, old))
    return type(old) is type(new) and old == new


def merged(expected: Sequence[Row], got: Sequence[Row]) -> list[Row]:
    """The new rows, with the old numbers where they agree within tolerance, so that unchanged lines stay the same."""
    pairs = _aligned(expected, got)
    return [new if old is None else _merged(old, new, "") for _, old, new in pairs if new is not None]


def _merged(old: Any, new: Any, path: str) -> Any:
    if isinstance(old, dict) and isinstance(new, dict):
        return {k: _merged(old.get(k, MISSING), v, f"{path}.{k}" if path else k) for k, v in new.items()}
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return [_merged(a, b, path) for a, b in zip(old, new, strict=True)]
    return old if _same(path, old, new) else new


def report(name: str, differences: Sequence[Difference], first: int = MAX_SHOWN_DIFFERENCES) -> str:
    """Readable report: the first differences, and a count by kind."""
    messages = len({d.number for d in differences})
    lines = [f"{name}: {messages} message(s) differ from the reference, {len(differences)} field(s):"]
    lines += [f"  {difference}" for difference in differences[:first]]
    if len(differences) > first:
        lines.append(f"  and {len(differences) - first} more; all of them by field:")
        kinds: dict[str, list[Difference]] = {}
        for each in differences:
            kinds.setdefault(f"{each.message.split(',')[0]} {_without_index(each.field)}".strip(), []).append(each)
        by_count = sorted(kinds.items(), key=lambda item: -len(item[1]))
        lines += [
            f"    {len(of_kind):4} x {kind}{_farthest(of_kind)}" for kind, of_kind in by_count[:MAX_SHOWN_DIFFERENCES]
        ]
        lines += (
            [f"    and {len(kinds) - MAX_SHOWN_DIFFERENCES} more fields"] if len(kinds) > MAX_SHOWN_DIFFERENCES else []
        )
    return "\n".join(lines)


def _farthest(differences: Sequence[Difference]) -> str:
    """The largest of some numbers' differences, in words."""
    off = [abs(d.got - d.expected) for d in differences if _is_number(d.got) and _is_number(d.expected)]
    return f", by up to {max(off):.3g}" if off else ""


def read(name: str, folder: Path = FOLDER) -> list[Row]:
    """Reads a reference; empty if there is none yet."""
    path = folder / f"{name}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def write(name: str, rows: Sequence[Row], folder: Path = FOLDER) -> Path:
    """Writes a reference, one line per row, with rounded numbers."""
    path = folder / f"{name}.jsonl"
    path.write_text("".join(json.dumps(_rounded(row)) + "\n" for row in rows))
    return path


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _kind(row: Row) -> str:
    first = next(name for name in row if name != "event")
    name = row[first] if first == "topic" else f"{first} {row[first]}" if isinstance(row[first], str) else first
    return f"{name}, stamp {row['stamp_ns'] * 1e-9:.3f} s" if "stamp_ns" in row else name


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)


def _without_index(field: str) -> str:
    return "".join(part.partition("]")[2] if "]" in part else part for part in field.split("["))


def _short(value: Any) -> str:
    text = f"{value:.7g}" if isinstance(value, float) else json.dumps(value) if value is not MISSING else MISSING
    return text if len(text) <= 80 else text[:77] + "..."
