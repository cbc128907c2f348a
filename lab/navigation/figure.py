"""Figure and table of the experiment."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.geometry.world import World
from lab.experiments.results import markdown, millimetres, number
from lab.navigation.worlds import world_of
from lab.statistics import wilson_interval
from presage.plotting import style as drawing

if TYPE_CHECKING:
    from lab.navigation.experiment import NavigationJob

Rows = Sequence[dict[str, Any]]
TITLE_WIDTH = 70  # characters above each column
LINES = ("-", "--", ":", "-.")
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def describe(job: NavigationJob) -> str:
    """The options that differ between experiments, in words."""
    parts = [f"start {job.start}", f"estimator {job.estimator}"]
    parts += [f"{job.people} people at {job.people_speed:g} m/s"] if job.people else []
    parts += [f"prior {job.prior}"] if job.prior != "motion" else []
    parts += [] if job.epistemic else ["without the epistemic term"]
    parts += ["scans distorted by motion"] if job.sweep else []
    parts += [f"{100 * job.slip:g} % wheel slip"] if job.slip else []
    parts += [f"range {job.range_max:g} m"] if job.range_max != type(job).range_max else []
    return ", ".join(parts)


def draw(by_group: Mapping[str, Rows], worlds: Mapping[str, str], title: str) -> Figure:
    """A map with the paths for each world and drive; below, the distributions of the path and time ratios.

    Of generated worlds, only the first is shown.
    """
    count = len(by_group)
    columns = min(2, count)
    rows_of_maps = -(-count // columns)
    world_of_group = {group: world_of(world, by_group[group][0]["world_seed"]) for group, world in worlds.items()}
    heights = [
        max(_height(world_of_group[group]) for group in list(world_of_group)[row * columns :][:columns])
        for row in range(rows_of_maps)
    ]
    figure = drawing.empty_figure(6.6 * columns, 6.2 * sum(heights) + 0.5 * rows_of_maps + 3.4)
    figure.suptitle(textwrap.fill(title, TITLE_WIDTH * columns), fontsize=11)
    grid = figure.add_gridspec(rows_of_maps + 1, 2 * columns, height_ratios=[*(6.2 * h + 0.5 for h in heights), 2.6])
    for index, (group, rows) in enumerate(by_group.items()):
        row, column = divmod(index, columns)
        _map(
            drawing.style_axes(figure.add_subplot(grid[row, 2 * column : 2 * column + 2])),
            world_of_group[group],
            group,
            rows,
        )
    left, right = (
        figure.add_subplot(grid[rows_of_maps, part]) for part in (slice(0, columns), slice(columns, 2 * columns))
    )
    for axes, quantity, label in (
        (left, "path_over_shortest", "path over the shortest way with clearance"),
        (right, "time_over_bound", "time over the least time"),
    ):
        _distribution(drawing.style_axes(axes), by_group, quantity, label)
    drawing.legend_below(figure, left)
    return figure


def _height(world: World) -> float:
    x0, y0, x1, y1 = world.bounds
    return (y1 - y0) / (x1 - x0)


def _map(axes: Axes, world: World, group: str, rows: Rows) -> None:
    drawing.world_map(axes, world)
    for row in rows:
        if row["world_seed"] != rows[0]["world_seed"]:
            continue
        colour = drawing.GOAL if row["reached"] else drawing.PREDICTED
        above = 3 if row["reached"] else 4
        axes.plot(row["x_m"], row["y_m"], color=colour, linewidth=0.7, alpha=0.8, zorder=above)
        axes.plot(*row["start"][:2], "o", color="black", markersize=2.5, zorder=5)
        axes.plot(*row["goal"], "x", color=drawing.MEASURED if row["reached"] else colour, markersize=4, zorder=5)
        for each in row["contact_at"]:
            axes.plot(each["x"], each["y"], "o", color="#CC79A7", fillstyle="none", markersize=8, zorder=6)
    reached = sum(row["reached"] for row in rows)
    axes.set_title(f"{group}: {reached} of {len(rows)} reached", fontsize=10)


def _distribution(axes: Axes, by_group: Mapping[str, Rows], quantity: str, label: str) -> None:
    """Plots the share of all trials that reached the goal within a ratio."""
    last = 1.1
    for index, (group, rows) in enumerate(by_group.items()):
        ratios = np.sort([row[quantity] for row in rows if row["reached"]])
        share = np.arange(1, len(ratios) + 1) / max(len(rows), 1)
        last = max(last, float(ratios.max(initial=0.0)))
        style = LINES[index // len(COLOURS) % len(LINES)]
        axes.step(
            [0.0, *ratios, 1e3],
            [0.0, *share, share[-1] if len(share) else 0.0],
            style,
            where="post",
            color=COLOURS[index % len(COLOURS)],
            label=group,
        )
    axes.set(xlabel=label, ylabel="share of trials", xlim=(0.95, last * 1.03), ylim=(0, 1.02))


COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {  # of the table, after the world and the drive
    "reached": lambda row: (
        f"{row['reached']}/{row['trials']} ({_percent(wilson_interval(row['reached'], row['trials']))})"
    ),
    "reported elsewhere": lambda row: str(row["trials_claimed_elsewhere"]),
    "contacts moving; standing": lambda row: (
        f"{row['trials_with_contact_moving']}; {row['trials_with_contact_standing']}"
    ),
    "path / shortest": lambda row: _median_and_max(row, "path_over_shortest"),
    "time / least": lambda row: _median_and_max(row, "time_over_bound"),
    "distance left (mm)": lambda row: f"{millimetres(row['median_left_m'])}; {millimetres(row['max_left_m'])}",
    "longest untracked (s)": lambda row: _median_and_max(row, "longest_untracked_s", 1),
    "gap (m)": lambda row: number(row["min_clearance_m"]),
    "to people (m)": lambda row: number(row["min_clearance_to_people_m"]),
    "error (mm)": lambda row: f"{millimetres(row['median_error_median_m'])}; {millimetres(row['max_error_max_m'])}",
}


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/navigation.md. Pairs are median; maximum. Brackets are a 95 % interval."""
    people = any(row["min_clearance_to_people_m"] is not None for row in summary.values())
    uncertain = any(row["median_longest_untracked_s"] > 0 for row in summary.values())
    contact = any(row["trials_with_contact_moving"] or row["trials_with_contact_standing"] for row in summary.values())
    shown = {"contacts moving; standing": contact, "longest untracked (s)": uncertain, "to people (m)": people}
    heads = [head for head in COLUMNS if shown.get(head, True)]
    rows = [[name, *(COLUMNS[head](row) for head in heads)] for name, row in summary.items()]
    bad = [
        f"- {name}, trial {each['trial']}, {each['outcome']}: {each['why']}"
        for name, row in summary.items()
        for each in row["worst"]
        if each["outcome"] != "reached" or "touched" in each["why"]
    ]
    return "\n\n".join([markdown(["world, drive", *heads], rows), *(["\n".join(bad)] if bad else [])])


def _median_and_max(row: Mapping[str, Any], quantity: str, digits: int = 3) -> str:
    return "; ".join(number(row[f"{statistic}_{quantity}"], digits) for statistic in ("median", "max"))


def _percent(interval: Sequence[float]) -> str:
    return f"{100 * interval[0]:.0f} to {100 * interval[1]:.0f} %"
