"""Compares two estimators: errors, consistency, times."""

from __future__ import annotations

import csv
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.messages.definitions import Belief, Truth
from presage.plotting.style import COLOURS, figure_of, legend_below, log_metres

OLD = "#444444"
SMALLEST = 1e-4  # m, the least a logarithmic axis shows


@dataclass
class Series:
    """Beliefs of one estimator, as they came."""

    name: str = ""
    stamps: list[int] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covariances: list[Array | None] = field(default_factory=list)
    states: list[str] = field(default_factory=list)
    took_ms: list[float] = field(default_factory=list)

    def add(self, belief: Belief, logged_ns: int, took_ms: float) -> None:
        """One more, and the time it took."""
        self.name = self.name or belief.estimator or "recorded"
        self.stamps.append(belief.stamp_ns)
        self.logged.append(logged_ns)
        self.poses.append(belief.pose.array())
        self.covariances.append(belief.covariance)
        self.states.append(belief.state)
        self.took_ms.append(took_ms)

    def index(self) -> dict[tuple[int, int], int]:
        """Place of the k-th belief of each stamp: a session begun anew uses stamps again."""
        seen: dict[int, int] = defaultdict(int)
        found = {}
        for place, stamp in enumerate(self.stamps):
            found[stamp, seen[stamp]] = place
            seen[stamp] += 1
        return found


@dataclass
class Track:
    """What a pass over a recording gathers: some hundred bytes a scan."""

    old: Series
    new: Series
    scanned_ns: int = 0  # when the last scan was published
    _truths: dict[int, list[tuple[int, Array]]] = field(default_factory=lambda: defaultdict(list))

    def true(self, truth: Truth, logged_ns: int) -> None:
        """Where the robot was."""
        self._truths[truth.stamp_ns].append((logged_ns, truth.pose.array()))

    def compare(self) -> Comparison:
        """On the scans both answered; on all where there are no old answers."""
        old, new = self.old.index(), self.new.index()
        both = [key for key in new if key in old] if old else list(new)
        rows = [new[key] for key in both]
        stamps = np.array([self.new.stamps[row] for row in rows], np.int64)
        return Comparison(
            stamps,
            self._part(self.old, [old[key] for key in both] if old else []),
            self._part(self.new, rows),
            {"recorded": len(self.old.stamps), "new": len(self.new.stamps)},
        )

    def _part(self, series: Series, rows: list[int]) -> Part:
        poses = np.array([series.poses[row] for row in rows]).reshape(-1, 3)
        true = np.array([self._true_pose(series, row) for row in rows]).reshape(-1, 3)
        errors = poses - true
        errors[:, 2] = se2.wrap(errors[:, 2])
        return Part(
            series.name, poses, errors, [series.covariances[row] for row in rows],
            np.array([series.states[row] == "tracking" for row in rows], bool),
            np.array([series.took_ms[row] for row in rows]),
        )  # fmt: skip

    def _true_pose(self, series: Series, row: int) -> Array:
        found = self._truths.get(series.stamps[row])
        if not found:
            return np.full(3, np.nan)
        return min(found, key=lambda entry: abs(entry[0] - series.logged[row]))[1]


@dataclass
class Part:
    """One of the two."""

    name: str
    poses: Array  # (N, 3)
    errors: Array  # (N, 3) m, m, rad from the truth; NaN where none was recorded
    covariances: list[Array | None]
    tracking: np.ndarray[Any, np.dtype[np.bool_]]  # (N,)
    took_ms: Array  # (N,)

    @property
    def beliefs(self) -> int:
        """How many."""
        return len(self.poses)

    @property
    def position(self) -> Array:
        """(N,) m from the truth."""
        return np.asarray(np.hypot(self.errors[:, 0], self.errors[:, 1]), float)

    def nees(self) -> Array:
        """(M,) normalised estimation error squared of those tracking; 3 on average where covariances are right."""
        found = []
        for error, covariance, tracking in zip(self.errors, self.covariances, self.tracking, strict=True):
            if tracking and covariance is not None and np.isfinite(error).all():
                found.append(float(error @ np.linalg.lstsq(covariance, error, rcond=None)[0]))
        return np.array(found)

    def as_dict(self) -> dict[str, Any]:
        """Plain names, units in them; None where nothing can be said. Errors of those that say tracking."""
        position, heading, nees = self.position[self.tracking], np.abs(self.errors[self.tracking, 2]), self.nees()
        return {
            "estimator": self.name,
            "beliefs": self.beliefs,
            "share_tracking": _of(np.mean, self.tracking.astype(float)),
            "position_error_median_m": _of(np.median, position),
            "position_error_rms_m": _of(lambda e: np.sqrt(np.mean(np.square(e))), position),
            "position_error_max_m": _of(np.max, position),
            "position_error_all_median_m": _of(np.median, self.position),
            "heading_error_median_rad": _of(np.median, heading),
            "nees_mean": _of(np.mean, nees),
            "update_ms_median": _of(np.median, self.took_ms),
            "update_ms_p95": _of(lambda t: np.quantile(t, 0.95), self.took_ms),
        }


@dataclass
class Comparison:
    """Old and new on the same scans."""

    stamps: np.ndarray[Any, np.dtype[np.int64]]  # (N,) ns
    old: Part  # nothing in it where no belief was recorded
    new: Part
    answered: dict[str, int]  # scans, by whom

    def difference(self) -> Array:
        """(N, 3) absolute; empty where there is nothing to compare with."""
        if not self.old.beliefs:
            return np.zeros((0, 3))
        away = self.new.poses - self.old.poses
        away[:, 2] = se2.wrap(away[:, 2])
        return np.abs(away)

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        away = self.difference()
        where = np.hypot(away[:, 0], away[:, 1])
        return {
            "scans_answered": self.answered, "scans_compared": len(self.stamps),
            "recorded": self.old.as_dict(), "new": self.new.as_dict(),
            "difference": {
                "position_median_m": _of(np.median, where), "position_max_m": _of(np.max, where),
                "heading_max_rad": _of(np.max, away[:, 2]),
            },
        }  # fmt: skip


def table(comparison: Comparison) -> Table:
    """For a terminal."""
    numbers = comparison.as_dict()
    old, new, away = numbers["recorded"], numbers["new"], numbers["difference"]
    made = Table(title=f"on the {numbers['scans_compared']} scans compared", title_justify="left")
    made.add_column("")
    made.add_column(f"recorded: {old['estimator'] or 'nothing'}", justify="right")
    made.add_column(f"new: {new['estimator']}", justify="right")
    answered = numbers["scans_answered"]
    made.add_row("scans answered in all", str(answered["recorded"]), str(answered["new"]))
    for words, name, factor, unit in (
        ("share tracking", "share_tracking", 100, "%"),
        ("position error once tracking, median", "position_error_median_m", 1e3, "mm"),
        ("  RMS", "position_error_rms_m", 1e3, "mm"),
        ("  at most", "position_error_max_m", 1e3, "mm"),
        ("position error of all, median", "position_error_all_median_m", 1e3, "mm"),
        ("heading error once tracking, median", "heading_error_median_rad", 180 / np.pi, "deg"),
        ("NEES (3 where covariances are right)", "nees_mean", 1, ""),
        ("time, median (recorded: scan to belief)", "update_ms_median", 1, "ms"),
        ("  95 %", "update_ms_p95", 1, "ms"),
    ):
        made.add_row(words, _words(old[name], factor, unit), _words(new[name], factor, unit))
    apart = (
        f"{_words(away['position_median_m'], 1e3, 'mm')} median, {_words(away['position_max_m'], 1e3, 'mm')} at most"
    )
    made.add_row("difference between the two", "", apart if comparison.old.beliefs else "-")
    return made


def draw(comparison: Comparison, out: Path) -> list[Path]:
    """Beside the recording ``out``: errors over time as PNG and PDF, their data as CSV; UserError where that fails."""
    columns = curves(comparison)
    files = [out.with_suffix(suffix) for suffix in (".png", ".pdf", ".csv")]
    figure = figure_of_curves(columns, comparison, out.stem)
    try:
        figure.savefig(files[0], dpi=150)
        figure.savefig(files[1], metadata={"CreationDate": None})  # the same data, the same bytes
        with files[2].open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))
    except OSError as error:
        raise UserError(f"{out.parent}: cannot be written to ({error.strerror}); choose another place") from None
    return files


def curves(comparison: Comparison) -> dict[str, Array]:
    """Columns of equal length (N,); NaN where nothing is known."""
    stamps, count = comparison.stamps, len(comparison.stamps)
    nothing, away = np.full(count, np.nan), comparison.difference()
    there = bool(comparison.old.beliefs)
    return {
        "time_s": (stamps - (stamps[0] if count else 0)) * 1e-9,
        "recorded_error_m": comparison.old.position if there else nothing,
        "new_error_m": comparison.new.position,
        "difference_m": np.hypot(away[:, 0], away[:, 1]) if there else nothing,
        "recorded_tracking": comparison.old.tracking.astype(float) if there else nothing,
        "new_tracking": comparison.new.tracking.astype(float),
    }


def figure_of_curves(columns: dict[str, Array], comparison: Comparison, title: str) -> Figure:
    """Errors over time, and the difference where there is no truth to compare with."""
    figure, (axes,) = figure_of(width=9.0)
    shown = [
        ("recorded_error_m", f"recorded: {comparison.old.name}", OLD, 1.1),
        ("new_error_m", f"new: {comparison.new.name}", COLOURS.get(comparison.new.name, "#0072B2"), 1.5),
    ]
    if not any(np.isfinite(columns[name]).any() for name, *_ in shown):
        shown = [("difference_m", "between the two", "#0072B2", 1.5)]
    for name, label, colour, width in shown:
        if np.isfinite(columns[name]).any():
            axes.plot(
                columns["time_s"], np.maximum(columns[name], SMALLEST), color=colour, linewidth=width, label=label
            )
    log_metres(axes)
    axes.set(xlabel="time (s)", ylabel="position error (m)" if len(shown) > 1 else "difference (m)", title=title)
    if axes.lines:
        legend_below(figure, axes)
    return figure


def _words(value: float | None, factor: float, unit: str) -> str:
    return "-" if value is None else f"{value * factor:.3g} {unit}".rstrip()


def _of(statistic: Any, values: Array) -> float | None:
    """Of those that are known."""
    known = values[np.isfinite(values)]
    return float(statistic(known)) if len(known) else None
