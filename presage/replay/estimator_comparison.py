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
from common.messages.definitions import Belief
from presage.plotting.style import COLOURS, MIN_LOG_VALUE, figure_of, legend_below, log_metres
from presage.recordings.session_summary import statistic_of_finite

RECORDED_COLOUR = "#444444"


@dataclass
class BeliefSeries:
    """The beliefs of one estimator, in the order in which they came."""

    name: str = ""
    stamps: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covariances: list[Array | None] = field(default_factory=list)
    states: list[str] = field(default_factory=list)
    update_ms: list[float] = field(default_factory=list)

    def add(self, belief: Belief, update_ms: float) -> None:
        """Adds a belief and the time that it took to compute."""
        self.name = self.name or belief.estimator or "recorded"
        self.stamps.append(belief.stamp_ns)
        self.poses.append(belief.pose.array())
        self.covariances.append(belief.covariance)
        self.states.append(belief.state)
        self.update_ms.append(update_ms)

    def index(self) -> dict[tuple[int, int], int]:
        """Index of each belief by (stamp, k), the k-th of that stamp: a restarted simulation uses stamps again."""
        counts: dict[int, int] = defaultdict(int)
        result = {}
        for index, stamp in enumerate(self.stamps):
            result[stamp, counts[stamp]] = index
            counts[stamp] += 1
        return result

    def result(self, rows: list[int], truth: Array) -> EstimatorResult:
        """The beliefs ``rows`` (M,) with their errors against ``truth`` (M, 3)."""
        poses = np.array([self.poses[row] for row in rows]).reshape(-1, 3)
        errors = poses - truth
        errors[:, 2] = se2.wrap(errors[:, 2])
        return EstimatorResult(
            self.name,
            poses,
            errors,
            [self.covariances[row] for row in rows],
            np.array([self.states[row] == "tracking" for row in rows], bool),
            np.array([self.update_ms[row] for row in rows]),
        )


def compare(old: BeliefSeries, new: BeliefSeries, truth: Array | None, changes: str = "") -> Comparison:
    """Compares the beliefs of the scans that both answered; of all scans if there are no recorded beliefs.

    ``truth`` (N, 3) has a row for each new belief; ``changes`` names the settings that differ.
    """
    old_index, new_index = old.index(), new.index()
    both = [key for key in new_index if key in old_index] if old_index else list(new_index)
    rows = [new_index[key] for key in both]
    poses = np.full((len(rows), 3), np.nan) if truth is None else truth[rows].reshape(-1, 3)
    old_rows = [old_index[key] for key in both] if old_index else []
    return Comparison(
        np.array([new.stamps[row] for row in rows], np.int64),
        old.result(old_rows, poses[: len(old_rows)]),
        new.result(rows, poses),
        {"recorded": len(old.stamps), "new": len(new.stamps)},
        changes,
    )


@dataclass
class EstimatorResult:
    """The beliefs of one estimator on the compared scans."""

    name: str
    poses: Array  # (N, 3)
    errors: Array  # (N, 3) m, m, rad against the truth; NaN where none was recorded
    covariances: list[Array | None]
    tracking: np.ndarray[Any, np.dtype[np.bool_]]  # (N,)
    update_ms: Array  # (N,)

    @property
    def beliefs(self) -> int:
        """Number of beliefs."""
        return len(self.poses)

    @property
    def position(self) -> Array:
        """Position errors (N,) m."""
        return np.asarray(np.hypot(self.errors[:, 0], self.errors[:, 1]), float)

    def nees(self) -> Array:
        """Normalised estimation errors squared (M,) while tracking; the mean is 3 if the covariances are correct."""
        values = []
        for error, covariance, tracking in zip(self.errors, self.covariances, self.tracking, strict=True):
            if tracking and covariance is not None and np.isfinite(error).all():
                values.append(float(error @ np.linalg.lstsq(covariance, error, rcond=None)[0]))
        return np.array(values)

    def as_dict(self) -> dict[str, Any]:
        """Statistics by names that contain their unit; None if unknown. Errors are those of beliefs while tracking."""
        position, heading, nees = self.position[self.tracking], np.abs(self.errors[self.tracking, 2]), self.nees()
        return {
            "estimator": self.name,
            "beliefs": self.beliefs,
            "share_tracking": statistic_of_finite(np.mean, self.tracking.astype(float)),
            "position_error_median_m": statistic_of_finite(np.median, position),
            "position_error_rms_m": statistic_of_finite(lambda e: np.sqrt(np.mean(np.square(e))), position),
            "position_error_max_m": statistic_of_finite(np.max, position),
            "position_error_all_median_m": statistic_of_finite(np.median, self.position),
            "heading_error_median_rad": statistic_of_finite(np.median, heading),
            "nees_mean": statistic_of_finite(np.mean, nees),
            "update_ms_median": statistic_of_finite(np.median, self.update_ms),
            "update_ms_p95": statistic_of_finite(lambda t: np.quantile(t, 0.95), self.update_ms),
        }


@dataclass
class Comparison:
    """Recorded and new beliefs on the same scans."""

    stamps: np.ndarray[Any, np.dtype[np.int64]]  # (N,) ns
    old: EstimatorResult  # empty if no belief was recorded
    new: EstimatorResult
    answered: dict[str, int]  # number of all beliefs, "recorded" and "new"
    changes: str = ""  # settings of the new estimator that differ from the recorded ones

    @property
    def new_title(self) -> str:
        """Title of the new beliefs, with the settings that differ."""
        return f"new: {self.new.name}" + (f", {self.changes}" if self.changes else "")

    def difference(self) -> Array:
        """Absolute differences (N, 3) in m, m, rad; (0, 3) if no belief was recorded."""
        if not self.old.beliefs:
            return np.zeros((0, 3))
        difference = self.new.poses - self.old.poses
        difference[:, 2] = se2.wrap(difference[:, 2])
        return np.abs(difference)

    def as_dict(self) -> dict[str, Any]:
        """The comparison as values that JSON can hold."""
        difference = self.difference()
        position = np.hypot(difference[:, 0], difference[:, 1])
        return {
            "scans_answered": self.answered,
            "scans_compared": len(self.stamps),
            "recorded": self.old.as_dict(),
            "new": self.new.as_dict(),
            "difference": {
                "position_median_m": statistic_of_finite(np.median, position),
                "position_max_m": statistic_of_finite(np.max, position),
                "heading_max_rad": statistic_of_finite(np.max, difference[:, 2]),
            },
        }


def comparison_table(comparison: Comparison) -> Table:
    """The comparison as a table for the terminal."""
    numbers = comparison.as_dict()
    old, new, difference = numbers["recorded"], numbers["new"], numbers["difference"]
    result = Table(title=f"on the {numbers['scans_compared']} scans compared", title_justify="left")
    result.add_column("")
    result.add_column(f"recorded: {old['estimator'] or 'nothing'}", justify="right")
    result.add_column(comparison.new_title, justify="right")
    answered = numbers["scans_answered"]
    result.add_row("scans answered in total", str(answered["recorded"]), str(answered["new"]))
    for title, name, factor, unit in (
        ("share of scans in state tracking", "share_tracking", 100, "%"),
        ("position error while tracking, median", "position_error_median_m", 1e3, "mm"),
        ("  RMS", "position_error_rms_m", 1e3, "mm"),
        ("  maximum", "position_error_max_m", 1e3, "mm"),
        ("position error of all scans, median", "position_error_all_median_m", 1e3, "mm"),
        ("heading error while tracking, median", "heading_error_median_rad", 180 / np.pi, "deg"),
        ("NEES (3 if covariances are correct)", "nees_mean", 1, ""),
        ("time, median (recorded: from scan to belief)", "update_ms_median", 1, "ms"),
        ("  95 %", "update_ms_p95", 1, "ms"),
    ):
        result.add_row(title, _format(old[name], factor, unit), _format(new[name], factor, unit))
    median, maximum = (_format(difference[name], 1e3, "mm") for name in ("position_median_m", "position_max_m"))
    summary = f"{median} median, {maximum} maximum"
    result.add_row("difference between the two", "", summary if comparison.old.beliefs else "-")
    return result


def draw_comparison(comparison: Comparison, out: Path) -> list[Path]:
    """Writes the errors over time beside the recording ``out``, as PNG, PDF and CSV; returns the files.

    Raises UserError if they cannot be written.
    """
    columns = curves(comparison)
    files = [out.with_suffix(suffix) for suffix in (".png", ".pdf", ".csv")]
    figure = figure_of_curves(columns, comparison, out.stem)
    try:
        figure.savefig(files[0], dpi=150)
        figure.savefig(files[1], metadata={"CreationDate": None})  # without a date, so that equal data give equal bytes
        with files[2].open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))
    except OSError as error:
        raise UserError(f"{out.parent}: cannot be written to ({error.strerror}); choose another place") from None
    return files


def curves(comparison: Comparison) -> dict[str, Array]:
    """The columns of the CSV file, each (N,); NaN for unknown values."""
    stamps, count = comparison.stamps, len(comparison.stamps)
    unknown, difference = np.full(count, np.nan), comparison.difference()
    has_recorded = bool(comparison.old.beliefs)
    return {
        "time_s": (stamps - (stamps[0] if count else 0)) * 1e-9,
        "recorded_error_m": comparison.old.position if has_recorded else unknown,
        "new_error_m": comparison.new.position,
        "difference_m": np.hypot(difference[:, 0], difference[:, 1]) if has_recorded else unknown,
        "recorded_tracking": comparison.old.tracking.astype(float) if has_recorded else unknown,
        "new_tracking": comparison.new.tracking.astype(float),
    }


def figure_of_curves(columns: dict[str, Array], comparison: Comparison, title: str) -> Figure:
    """Draws the errors over time, or the difference between the two if there is no truth."""
    figure, (axes,) = figure_of(width=9.0)
    shown = [
        ("recorded_error_m", f"recorded: {comparison.old.name}", RECORDED_COLOUR, 1.1),
        ("new_error_m", comparison.new_title, COLOURS.get(comparison.new.name, "#0072B2"), 1.5),
    ]
    if not any(np.isfinite(columns[name]).any() for name, *_ in shown):
        shown = [("difference_m", "difference between the two", "#0072B2", 1.5)]
    for name, label, colour, width in shown:
        if np.isfinite(columns[name]).any():
            axes.plot(
                columns["time_s"], np.maximum(columns[name], MIN_LOG_VALUE), color=colour, linewidth=width, label=label
            )
    log_metres(axes)
    axes.set(xlabel="time (s)", ylabel="position error (m)" if len(shown) > 1 else "difference (m)", title=title)
    if axes.lines:
        legend_below(figure, axes)
    return figure


def _format(value: float | None, factor: float, unit: str) -> str:
    return "-" if value is None else f"{value * factor:.3g} {unit}".rstrip()
