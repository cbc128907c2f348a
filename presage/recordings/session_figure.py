"""`presage plot`: draws a recorded session."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Polygon as Patch
from matplotlib.transforms import ScaledTranslation
from rich.console import Console

from common.errors import UserError
from common.geometry.se2 import Array, compose
from common.geometry.world import World
from common.messages.definitions import Goal, Scan
from common.robot.ranges import is_surface
from common.runtime import safety
from common.versions import commit
from presage.plotting.maps import draw_walls
from presage.plotting.style import log_metres, save_figure
from presage.recordings.recorded_session import RecordedSession, load_session
from presage.recordings.session_summary import print_summary, summarise, summary_of
from presage.terminal.output import check_file, write_json

# Palette of Okabe and Ito, suitable for colour-blind readers.
TRUTH, BELIEF, MEASURED, GOAL = "#000000", "#D55E00", "#0072B2", "#009E73"
WALL, FURNITURE, INK = "#8C8C8C", "#C8C8C8", "#555555"
FORMATS = (".png", ".pdf", ".svg")
MAX_TIES = 200  # lines between belief and truth
MIN_ERROR_M = 1e-5  # m, smallest error on the logarithmic axis


def draw_session(path: Path, png: Path, *, title: str | None = None) -> None:
    """Draws the recording at ``path`` into ``png``; a panel without data says what is missing.

    Raises UserError if the figure cannot be written.
    """
    session = load_session(path)
    figure = figure_of(session, title if title is not None else path.stem)
    try:
        save_figure(figure, png, dpi=150)
    except OSError as error:
        raise UserError(f"{png}: cannot be written ({error.strerror}); choose another place for the figure") from None


def plot_command(recording: Path, figure: Path, json_file: Path | None, console: Console) -> None:
    """Prints the summary of a recording and draws its figure. Raises UserError if an option is wrong."""
    if figure.suffix not in FORMATS:
        raise UserError(f"{figure}: the name of the figure must end with {' or '.join(FORMATS)}")
    check_file(figure, "--out")
    check_file(json_file, "--json")
    summary = summarise(recording)
    draw_session(recording, figure)
    print_summary(summary, recording, figure, console)
    write_json(json_file, {**summary.as_dict(), "commit": commit(), "arguments": sys.argv[1:]})


def figure_of(session: RecordedSession, title: str) -> Figure:
    """The figure, 12 inches wide; its height follows the world's shape."""
    map_height = 4.0
    if session.world is not None:
        x0, y0, x1, y1 = session.world.bounds
        map_height = float(np.clip(11.2 * (y1 - y0) / (x1 - x0), 2.5, 6.0)) + 0.7
    figure = Figure(figsize=(12, map_height + 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)  # type: ignore[union-attr, call-arg]
    figure.suptitle(f"{title}\n", fontsize=13, fontweight="bold")
    figure.text(0.5, 0.985 - 0.36 / (map_height + 4.4), _headline(session), ha="center", va="center", color=INK)
    grid = figure.add_gridspec(2, 3, height_ratios=(map_height, 3.4))
    _draw_map(figure.add_subplot(grid[0, :]), session)
    _draw_scan(figure.add_subplot(grid[1, 0]), session)
    _draw_free_energy(figure.add_subplot(grid[1, 1]), session)
    _draw_errors(figure.add_subplot(grid[1, 2]), session)
    return figure


def _headline(session: RecordedSession) -> str:
    """The main results of the session in one line."""
    summary = summary_of(session)
    parts = [f"world {summary.world}" if summary.world else "world unknown"]
    if len(session.belief):
        estimator = f" by preset {session.estimator}" if session.estimator else ""
        localised = "localised before the recording" if summary.localised_before_recording else "not localised"
        if summary.localised_after_scans is not None:
            localised = f"localised at scan {summary.localised_after_scans}"
        parts.append(localised + estimator)
    if summary.position_error_m is not None:
        parts.append(f"position error at the end {_length(summary.position_error_m)}")
    if summary.goal_reached is not None:
        distance = f", {_length(summary.goal_distance_m)} away" if summary.goal_distance_m is not None else ""
        parts.append(f"goal {summary.goal_result()}{distance}")
    return "  ·  ".join(parts if summary.complete else [*parts, "recording incomplete"])


def _length(metres: float) -> str:
    return f"{metres * 1e3:.1f} mm" if metres < 0.1 else f"{metres:.2f} m"


def _missing(axes: Axes, what: str) -> None:
    axes.text(0.5, 0.5, f"no {what} in this recording", ha="center", va="center", transform=axes.transAxes, color=INK)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color("#DDDDDD")


def _style_axes(axes: Axes, letter: str, title: str) -> None:
    """Adds title and grid to a panel."""
    axes.set_title(f"{letter}  {title}", fontsize=10.5, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, which="major", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)


def _draw_world(axes: Axes, world: World) -> None:
    draw_walls(axes, world, WALL)
    for obstacle in world.obstacles:
        style = {"facecolor": FURNITURE, "edgecolor": WALL, "linewidth": 0.8, "zorder": 1.0}
        if obstacle.circle is not None:
            axes.add_patch(Disc(obstacle.circle.center, obstacle.circle.radius, **style))
        elif (ring := obstacle.ring()) is not None:
            axes.add_patch(Patch(ring, closed=True, **style))
    x0, y0, x1, y1 = world.bounds
    axes.set(xlim=(x0 - 0.3, x1 + 0.3), ylim=(y0 - 0.3, y1 + 0.3))


def _draw_map(axes: Axes, session: RecordedSession) -> None:
    true, believed, goal = session.truth.poses, session.belief.poses, session.goal()
    if session.world is None and not len(true) and not len(believed):
        _missing(axes, "world and no path")
        return
    if session.world is not None:
        _draw_world(axes, session.world)
    if session.last_scan is not None and len(true):
        points = _scan_in_map(session.last_scan, true[-1])
        axes.plot(*points.T, ".", color=MEASURED, markersize=2, label="last scan", zorder=2)
    if goal is not None:
        _draw_goal(axes, goal)
    if len(believed):
        axes.plot(believed[:, 0], believed[:, 1], "-", color=BELIEF, linewidth=1.5, label="believed path", zorder=4)
        axes.plot(*believed[0, :2], "s", color=BELIEF, markersize=6, label="first belief", zorder=4)
        axes.plot(*believed[-1, :2], "x", color=BELIEF, markersize=7, mew=1.8, label="last belief", zorder=6)
    if len(true):
        _draw_ties(axes, session)
        axes.plot(true[:, 0], true[:, 1], "--", color=TRUTH, linewidth=1.5, label="true path", zorder=5)
        axes.plot(*true[0, :2], "o", color=TRUTH, markersize=6, label="true start", zorder=5)
        (x, y, yaw), radius = true[-1], session.base.radius
        axes.add_patch(Disc((x, y), radius, facecolor="#00000014", edgecolor=TRUTH, linewidth=1.2, zorder=5))
        axes.plot([x, x + radius * np.cos(yaw)], [y, y + radius * np.sin(yaw)], color=TRUTH, linewidth=1.2, zorder=5)
    _style_axes(axes, "a", "map")
    axes.grid(visible=False)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    below = axes.transAxes + ScaledTranslation(0, -0.45, axes.figure.dpi_scale_trans)
    if axes.get_legend_handles_labels()[0]:  # a log without poses has only the world
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, 0), bbox_transform=below, ncols=9, fontsize=8.5, frameon=False
        )


def _draw_goal(axes: Axes, goal: Goal) -> None:
    where = (goal.pose.x, goal.pose.y)
    axes.add_patch(Disc(where, goal.tolerance, facecolor=GOAL + "30", edgecolor=GOAL, linewidth=1, zorder=3))
    axes.plot(*where, "*", color=GOAL, markersize=11, label="goal and tolerance", zorder=6)


def _draw_ties(axes: Axes, session: RecordedSession) -> None:
    """Draws lines between truth and belief of the same stamp, because paths that coincide may differ in time.

    One line each second, in long sessions fewer.
    """
    stamps = session.belief.stamps_ns
    known = np.flatnonzero(np.isfinite(session.true_poses[:, 0]))
    if not len(known):
        return
    every = max(1, round(float(np.ptp(stamps[known])) * 1e-9 / MAX_TIES))  # s
    selected, next_s = list[int](), -np.inf
    for row in known:
        if stamps[row] * 1e-9 >= next_s - 1e-6:
            next_s = stamps[row] * 1e-9 + every
            selected.append(int(row))
    believed, true = session.belief.poses[selected, :2], session.true_poses[selected, :2]
    ties = np.stack([believed, true, np.full_like(true, np.nan)], axis=1).reshape(-1, 2)
    label = "truth and belief, each second" if every == 1 else f"truth and belief, every {every} s"
    axes.plot(*ties.T, color=INK, linewidth=0.9, alpha=0.6, label=label, zorder=3.5)
    axes.plot(*true.T, ".", color=TRUTH, markersize=5, zorder=5)
    axes.plot(*believed.T, ".", color=BELIEF, markersize=5, zorder=4)


def _scan_in_map(scan: Scan, pose: Array) -> Array:
    points = safety.scan_points(scan)
    return compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]


def _draw_scan(axes: Axes, session: RecordedSession) -> None:
    """Draws the last scan with a prediction, as in figure 2c of the paper."""
    if session.predicted is None:
        _missing(axes, "predicted scan")
        return
    scan, prediction = session.predicted
    expected = np.where(np.isfinite(prediction.ranges), prediction.ranges, np.nan).astype(np.float64)
    measured = np.where(is_surface(scan.ranges), scan.ranges, np.nan)
    angles = np.rad2deg(prediction.angle_min + prediction.angle_increment * np.arange(len(expected)))
    axes.plot(np.rad2deg(scan.angles()), measured, color=MEASURED, lw=1.4, label="measured")
    axes.plot(angles, expected, color=BELIEF, lw=1.2, label="predicted")
    if len(prediction.sigma) == len(expected):
        low, high = expected - 2 * prediction.sigma, expected + 2 * prediction.sigma
        axes.fill_between(angles, low, high, color=BELIEF, alpha=0.2, lw=0, label="± 2σ")
    _style_axes(axes, "b", f"scan and prediction at {scan.stamp_ns * 1e-9:.1f} s")
    axes.set(xlabel="beam angle (deg)", ylabel="range (m)", ylim=(0, None))
    axes.set_xticks([t for t in range(-360, 361, 45) if angles.min() - 5 <= t <= angles.max() + 5])
    axes.legend(fontsize=8.5, frameon=False)


def _draw_free_energy(axes: Axes, session: RecordedSession) -> None:
    total, accuracy, complexity = session.energies().T
    if not np.isfinite(total).any():
        _missing(axes, "free energy" if len(total) else "belief")
        return
    time, shown = session.belief.stamps_ns * 1e-9, [total]
    has_complexity = bool(np.nan_to_num(complexity).any())
    axes.plot(time, total, color=BELIEF, lw=2.2 if has_complexity else 1.5, label="free energy F")
    if has_complexity:
        shown = [total, accuracy, complexity]
        axes.plot(time, accuracy, color=MEASURED, lw=1.1, label="accuracy, −ln p(o|x)")
        axes.plot(time, complexity, color=GOAL, lw=1.1, label="complexity")
    low, high = np.nanmin(shown), np.nanmax(shown)
    if low > 0 and high > 30 * low:
        axes.set_yscale("log")
    _mark_moments(axes, session)
    _style_axes(axes, "c", "free energy")
    axes.set(xlabel="time (s)", ylabel="F (nats)")
    axes.legend(fontsize=8.5, frameon=False)


def _draw_errors(axes: Axes, session: RecordedSession) -> None:
    """Draws the error of the belief, and the distance to the goal in green, as in figure 3 of the paper."""
    errors, goal = session.errors(), session.goal()
    known = np.isfinite(errors)
    if not known.any():
        _missing(axes, "truth beside beliefs")
        return
    time = session.belief.stamps_ns * 1e-9
    log_metres(axes)
    axes.plot(time[known], np.maximum(errors[known], MIN_ERROR_M), color=BELIEF, lw=1.4, label="position error")
    if goal is not None:
        stamps = session.truth.stamps_ns
        distance = np.hypot(*(session.truth.poses - goal.pose.array())[:, :2].T)
        navigating = stamps >= session.goal_times_ns[-1]
        shown = np.maximum(distance[navigating], MIN_ERROR_M)
        axes.plot(stamps[navigating] * 1e-9, shown, color=GOAL, lw=1.4, label="distance to goal")
    _mark_moments(axes, session)
    _style_axes(axes, "d", "position error and distance to goal")
    low, high = axes.get_ylim()
    if high < 2 * low:  # the curves are almost constant: avoid an axis that shows rounding errors
        axes.set_ylim(low / 2, 2 * high)
    axes.grid(visible=True, which="minor", color="#EEEEEE", linewidth=0.4)
    axes.set(xlabel="time (s)", ylabel="distance (m)")
    axes.legend(fontsize=8.5, frameon=False, labelspacing=0.2)


def _mark_moments(axes: Axes, session: RecordedSession) -> None:
    """Marks the times of the first belief in state tracking and of reaching the goal."""
    first, reached = session.localised(), session.reached_ns()
    if first is not None:
        axes.axvline(session.belief.stamps_ns[first] * 1e-9, color=INK, lw=0.9, ls=":", label="localised")
    if reached is not None:
        axes.axvline(reached * 1e-9, color=GOAL, lw=0.9, ls=":", label="goal reached")
