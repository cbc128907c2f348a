"""Colours, marks and axes of figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import FuncFormatter

from common.geometry.se2 import Array
from common.geometry.world import World
from common.writing import complete_files
from presage.plotting.maps import draw_cells

# Palette of Okabe and Ito, the same in every figure. Green is the colour of the distance to the goal in the paper.
COLOURS = {
    "paper": "#E69F00",
    "paper, 10 steps a scan": "#E69F00",
    "precise": "#0072B2",
    "precise-exact": "#009E73",
    "particle-filter": "#D55E00",
    "particle-filter-scan-matching": "#E69F00",
    "amcl-defaults": "#CC79A7",
    "particle-filter, heading known": "#000000",
    "precise, odometry": "#56B4E9",
    "particle-filter, odometry": "#999999",
    "amcl-defaults, odometry": "#CC79A7",
}
DASHED = ("paper, 10 steps a scan",)  # estimators that share a colour with another
MEASURED, PREDICTED, GOAL, BOUND = "#0072B2", "#D55E00", "#009E73", "#444444"
MIN_LOG_VALUE = 1e-4  # m, lower limit of the bands of one standard deviation on logarithmic axes


def figure_of(columns: int = 1, rows: int = 1, *, width: float = 7.0, height: float = 4.2) -> tuple[Figure, list[Axes]]:
    """Returns a figure with empty panels of ``width`` x ``height`` inches each, and the panels row by row."""
    figure = empty_figure(width * columns, height * rows)
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, [style_axes(each) for each in axes.ravel()]


def empty_figure(width: float, height: float) -> Figure:
    """A figure without panels; the size is in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path, **options: Any) -> None:
    """Writes a figure, with options of `savefig`. An OSError names ``path``, and an existing file stays."""
    with complete_files(path) as partial:
        figure.savefig(partial / path.name, **options)


def style_axes(axes: Axes) -> Axes:
    """Gives the axes a light grid and no frame; returns them."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, which="major", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    return axes


def band(
    axes: Axes, x: Sequence[float] | Array, rows: Sequence[Sequence[float]] | Array, name: str, colour: str = ""
) -> None:
    """Draws the mean over trials (N, K) with a band of one standard deviation, which stays positive for log axes."""
    values = np.asarray(rows, float)
    mean, std = values.mean(axis=0), values.std(axis=0)
    _band(axes, x, mean, (np.maximum(mean - std, MIN_LOG_VALUE), mean + std), name, colour)


def quartiles(axes: Axes, x: Sequence[float] | Array, rows: Sequence[Sequence[float]] | Array, name: str) -> None:
    """Draws the median over trials (N, K) with a band from the first to the third quartile, for logarithmic axes."""
    low, middle, high = np.quantile(np.asarray(rows, float), (0.25, 0.5, 0.75), axis=0)
    _band(axes, x, middle, (low, high), name)


def line(axes: Axes, x: Sequence[float], y: Sequence[float], name: str, colour: str = "") -> None:
    """Draws a line in the colour and style of the estimator ``name``."""
    colour = colour or COLOURS.get(name, GOAL)
    axes.plot(x, y, "--" if name in DASHED else "-", color=colour, linewidth=1.6, label=name)


def _band(
    axes: Axes, x: Sequence[float] | Array, middle: Array, edges: tuple[Array, Array], name: str, colour: str = ""
) -> None:
    colour = colour or COLOURS.get(name, GOAL)
    line(axes, x, middle, name, colour)  # type: ignore[arg-type]
    axes.fill_between(x, *edges, color=colour, alpha=0.18, linewidth=0)


def pad_with_last(rows: Sequence[Sequence[float]], length: int) -> Array:
    """Array (N, ``length``) of rows of different lengths, each continued with its last value."""
    return np.array([[*row, *[row[-1]] * (length - len(row))] for row in rows])


def world_map(axes: Axes, world: World) -> None:
    """Draws the walls and furniture of a world; axes in m."""
    if world.grid is not None:
        draw_cells(axes, world.grid, "black")
    for ring in world.wall_rings:
        axes.add_patch(Polygon(np.array(ring), fill=False, edgecolor="black", linewidth=1.2))
    for obstacle in world.obstacles:
        outline = shapely.get_coordinates(obstacle.shape())
        axes.add_patch(Polygon(outline, facecolor="#BBBBBB", edgecolor="black", linewidth=0.6))
    x0, y0, x1, y1 = world.bounds
    axes.set(xlim=(x0 - 0.2, x1 + 0.2), ylim=(y0 - 0.2, y1 + 0.2), aspect="equal", xlabel="x (m)", ylabel="y (m)")


def legend_below(figure: Figure, *panels: Axes) -> None:
    """Adds one legend for all panels below the figure."""
    named = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(
        named.values(), named.keys(), loc="outside lower center", ncols=min(len(named), 5), fontsize=9, frameon=False
    )


def log_metres(axes: Axes, axis: str = "y") -> None:
    """Makes an axis logarithmic with labels such as 0.01 instead of 10^-2."""
    axes.set(**{f"{axis}scale": "log"})
    (axes.yaxis if axis == "y" else axes.xaxis).set_major_formatter(FuncFormatter(_tick))


def _tick(value: float, _: int | None) -> str:
    """A number without an exponent, such as 0.00001."""
    return np.format_float_positional(value, precision=6, fractional=False, trim="-")
