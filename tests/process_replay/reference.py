"""References as text files: rows of plain values with rounded numbers; long arrays as a few statistics and samples.

Rows are compared field by field. States, counts and text must be equal. Numbers may differ by `tolerance`, because
processors differ in the order of sums and in the rounding of functions such as the sine.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]

FOLDER = Path(__file__).resolve().parent / "references"
DIGITS = 7  # significant digits of numbers in a file
SAMPLES = 6  # stored values of a long array
MISSING = "nothing"
# Absolute and relative tolerance by the last name in a field's path that is listed here, otherwise of "". Run without
# AVX and FMA, with another BLAS kernel and two threads, the same code gave differences of 6e-7 (relative) and 3e-7 m in
# the network of preset paper (float32), and of 1e-15 elsewhere; ten times that is allowed. xi is a difference of large
# numbers.
TOLERANCES = {"": (1e-6, 5e-6), "xi": (1e-2, 1e-5)}


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


def compare(expected: Sequence[Row], got: Sequence[Row]) -> list[str]:
    """A line for every field that differs, and for every message that is missing or new."""
    found = []
    for number, old, new in _pair_rows(expected, got):
        where = f"message {number} ({_kind(old or new or {})})"
        if old is None or new is None:
            found.append(f"{where}: " + ("missing" if new is None else "new, the reference has none"))
        else:
            found += [f"{where}: {line}" for line in _compare("", old, new)]
    return found


def _pair_rows(expected: Sequence[Row], got: Sequence[Row]) -> Iterator[tuple[int, Row | None, Row | None]]:
    """Pairs messages of the same kind and stamp. Yields the number and both rows, None for a missing one."""
    matcher = SequenceMatcher(None, [_kind(row) for row in expected], [_kind(row) for row in got], autojunk=False)
    for what, a, after_a, b, after_b in matcher.get_opcodes():
        if what == "equal":
            yield from ((a + k, expected[a + k], got[b + k]) for k in range(after_a - a))
        else:
            yield from ((number, expected[number], None) for number in range(a, after_a))
            yield from ((number, None, got[number]) for number in range(b, after_b))


def _compare(path: str, old: Any, new: Any) -> Iterator[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        for name in dict.fromkeys([*old, *new]):
            yield from _compare(f"{path}.{name}" if path else name, old.get(name, MISSING), new.get(name, MISSING))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from _compare(f"{path}[{index}]", a, b)
    elif not _same(path, old, new):
        yield f"{path}: expected {_short(old)}, got {_short(new)}"


def _same(path: str, old: Any, new: Any) -> bool:
    if _is_number(old) and _is_number(new) and (isinstance(old, float) or isinstance(new, float)):
        return old == new or (math.isfinite(old) and abs(old - new) <= tolerance(path, old))
    return type(old) is type(new) and old == new


def merged(expected: Sequence[Row], got: Sequence[Row]) -> list[Row]:
    """The new rows, with the old numbers where they agree within tolerance, so that unchanged lines stay the same."""
    pairs = _pair_rows(expected, got)
    return [new if old is None else _merged(old, new, "") for _, old, new in pairs if new is not None]


def _merged(old: Any, new: Any, path: str) -> Any:
    if isinstance(old, dict) and isinstance(new, dict):
        return {k: _merged(old.get(k, MISSING), v, f"{path}.{k}" if path else k) for k, v in new.items()}
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return [_merged(a, b, path) for a, b in zip(old, new, strict=True)]
    return old if _same(path, old, new) else new


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


def _short(value: Any) -> str:
    text = f"{value:.7g}" if isinstance(value, float) else json.dumps(value) if value is not MISSING else MISSING
    return text if len(text) <= 80 else text[:77] + "..."
