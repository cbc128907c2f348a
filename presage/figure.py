"""The picture of a recorded session: map and paths, scan against prediction, free energy, errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Polygon as Patch

from common import safety
from common.messages import Prediction, Scan
from common.robot import Robot
from common.se2 import Array, compose
from common.world import World
from presage.session import Session, load_session

# Okabe and Ito: told apart by the colour-blind.
TRUTH, BELIEF, MEASURED, GOAL = "#000000", "#D55E00", "#0072B2", "#009E73"
WALL, GRID = "#555555", {"alpha": 0.25, "linewidth": 0.6}


def draw_session(path: Path, png: Path, title: str | None = None) -> None:
    """Draw the recording at ``path`` into ``png``; what is missing is said in its panel."""
    session = load_session(path)
    figure = Figure(figsize=(12, 8.2), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title or f"{session.world.name if session.world else 'session'}: {path.stem}", fontsize=11)
    grid = figure.add_gridspec(2, 3, height_ratios=(1.0, 0.95))
    _draw_map(figure.add_subplot(grid[0, :]), session)
    _draw_scan(figure.add_subplot(grid[1, 0]), session)
    _draw_free_energy(figure.add_subplot(grid[1, 1]), session)
    _draw_errors(figure.add_subplot(grid[1, 2]), session)
    figure.savefig(png, dpi=150)


def _missing(axes: Axes, what: str) -> None:
    axes.text(0.5, 0.5, f"no {what} in this recording", ha="center", va="center", transform=axes.transAxes, color=WALL)
    axes.set(xticks=[], yticks=[])


def _draw_world(axes: Axes, world: World) -> None:
    axes.add_patch(Patch(world.boundary, closed=True, facecolor="white", edgecolor=WALL, linewidth=2.5, zorder=0))
    for obstacle in world.obstacles:
        if obstacle.circle is not None:
            axes.add_patch(Disc(obstacle.circle.center, obstacle.circle.radius, facecolor="#BBBBBB", edgecolor=WALL))
        elif (ring := obstacle.ring()) is not None:
            axes.add_patch(Patch(ring, closed=True, facecolor="#BBBBBB", edgecolor=WALL))


def _draw_map(axes: Axes, session: Session) -> None:
    true, believed, goal = session.true_path(), session.believed_path(), session.goal()
    if session.world is None and not len(true) and not len(believed):
        _missing(axes, "world and no path")
        return
    if session.world is not None:
        _draw_world(axes, session.world)
        x0, y0, x1, y1 = session.world.bounds
        axes.set(xlim=(x0 - 0.3, x1 + 0.3), ylim=(y0 - 0.3, y1 + 0.3))
    if session.scans and len(true):
        points = _scan_in_map(session.scans[-1], true[-1])
        axes.plot(*points.T, ".", color=MEASURED, markersize=2.5, label="last scan")
    if len(believed):
        axes.plot(believed[:, 0], believed[:, 1], "-", color=BELIEF, linewidth=1.3, label="believed path")
        axes.plot(*believed[0, :2], "s", color=BELIEF, markersize=6, label="first belief")
    if len(true):
        axes.plot(true[:, 0], true[:, 1], "--", color=TRUTH, linewidth=1.5, label="true path")
        axes.plot(*true[0, :2], "o", color=TRUTH, markersize=6, label="true start")
        x, y, yaw = true[-1]
        axes.add_patch(Disc((x, y), Robot().radius, facecolor="none", edgecolor=TRUTH, linewidth=1.2))
        axes.plot([x, x + Robot().radius * np.cos(yaw)], [y, y + Robot().radius * np.sin(yaw)], color=TRUTH)
    if goal is not None:
        axes.plot(goal.pose.x, goal.pose.y, "*", color=GOAL, markersize=14, label="goal", zorder=5)
        axes.add_patch(Disc((goal.pose.x, goal.pose.y), goal.tolerance, facecolor="none", edgecolor=GOAL))
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.grid(**GRID)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=7, fontsize=8, frameon=False)


def _scan_in_map(scan: Scan, pose: Array) -> Array:
    points = safety.scan_points(scan)
    return compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]


def _draw_scan(axes: Axes, session: Session) -> None:
    """The paper's figure 2c, for the last scan that was predicted."""
    scans = {scan.stamp_ns: scan for scan in session.scans}
    pairs: list[tuple[Scan, Prediction]] = [(scans[p.stamp_ns], p) for p in session.predictions if p.stamp_ns in scans]
    if not pairs:
        _missing(axes, "predicted scan")
        return
    scan, prediction = pairs[-1]
    angles = np.rad2deg(scan.angles())
    expected = np.array(prediction.ranges, float)
    axes.plot(angles, np.where(np.isfinite(scan.ranges), scan.ranges, np.nan), color=MEASURED, lw=1.4, label="measured")
    axes.plot(angles[: len(expected)], expected, color=BELIEF, lw=1.1, label="predicted")
    if len(prediction.sigma):
        axes.fill_between(angles, expected - 2 * prediction.sigma, expected + 2 * prediction.sigma, color=BELIEF, alpha=0.2)
    axes.set(xlabel="beam angle (deg)", ylabel="range (m)", ylim=(0, None))
    axes.set_title(f"scan at {scan.stamp_ns * 1e-9:.1f} s", fontsize=10)
    axes.grid(**GRID)
    axes.legend(fontsize=8, frameon=False)


def _draw_free_energy(axes: Axes, session: Session) -> None:
    if not session.beliefs:
        _missing(axes, "belief")
        return
    time = np.array([b.stamp_ns for b in session.beliefs]) * 1e-9
    values = {
        "F": np.array([b.free_energy for b in session.beliefs]),
        "accuracy": np.array([b.accuracy for b in session.beliefs]),
        "complexity": np.array([b.complexity for b in session.beliefs]),
    }
    if values["complexity"].any():
        axes.plot(time, values["accuracy"], color=MEASURED, lw=1, label="accuracy")
        axes.plot(time, values["complexity"], color=GOAL, lw=1, label="complexity")
    axes.plot(time, values["F"], color=BELIEF, lw=1.3, label="free energy F")
    low, high = float(values["F"].min()), float(values["F"].max())
    if low > 0 and high > 20 * low:
        axes.set_yscale("log")
    axes.set(xlabel="time (s)", ylabel="free energy (nats)")
    axes.set_title("free energy", fontsize=10)
    axes.grid(**GRID)
    axes.legend(fontsize=8, frameon=False)


def _draw_errors(axes: Axes, session: Session) -> None:
    """The paper's figure 3: error of the belief, and the distance to the goal in green."""
    errors, goal = session.errors(), session.goal()
    known = np.isfinite(errors)
    if not known.any():
        _missing(axes, "truth beside beliefs")
        return
    time = np.array([b.stamp_ns for b in session.beliefs]) * 1e-9
    axes.semilogy(time[known], np.maximum(errors[known], 1e-4), color=BELIEF, lw=1.2, label="position error")
    if goal is not None:
        since = np.array([t.stamp_ns for t in session.truths]) * 1e-9
        away = np.hypot(*(session.true_path() - goal.pose.array())[:, :2].T)
        asked = since >= goal.stamp_ns * 1e-9
        axes.semilogy(since[asked], away[asked], color=GOAL, lw=1.4, label="distance to goal")
    if (first := next((b for b in session.beliefs if b.state == "tracking"), None)) is not None:
        axes.axvline(first.stamp_ns * 1e-9, color=WALL, lw=0.8, ls=":", label="localised")
    axes.set(xlabel="time (s)", ylabel="m")
    axes.set_title("position error and distance to goal", fontsize=10)
    axes.grid(which="both", **GRID)
    axes.legend(fontsize=8, frameon=False)
