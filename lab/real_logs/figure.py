"""The figure of the experiment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lab.real_logs.drive import LASER, ODOMETRY
from lab.real_logs.scoring import CORRECT_DISTANCE_M
from presage.learning.field_figure import calibration_curve
from presage.plotting import style as drawing
from services.estimator.precise.learning.calibration import Calibration

MIN_DRAWN_ERROR = 1e-3  # m; smaller errors are drawn at this value


def draw(calibration: Calibration | None, rows: Sequence[dict[str, Any]], titles: dict[str, str]) -> Figure:
    """Cumulative distribution of the errors, calibration, and errors over time with and without odometry."""
    figure = drawing.empty_figure(14, 9)
    panels = figure.subplots(2, 2, width_ratios=(1.6, 1))
    cumulative = drawing.style_axes(panels[0, 0])
    for axes, task, style in zip(panels[1], (ODOMETRY, LASER), ("-", "--"), strict=True):
        drawing.style_axes(axes)
        for row in (row for row in rows if row["task"] == task):
            colour, name = drawing.COLOURS[row["estimator"]], row["estimator"]
            error = np.maximum(row["error_m"], MIN_DRAWN_ERROR)
            stamps = np.array(row["stamp_s"]) - row["stamp_s"][0]
            axes.plot(stamps, error, linewidth=0.9, color=colour, label=name)
            share = np.arange(1, len(error) + 1) / len(error)
            cumulative.plot(np.sort(error), share, style, color=colour)
        cumulative.plot([], [], style, color="black", label=titles[task])  # the colours are those of the legend below
        drawing.log_metres(axes)
        axes.axhline(CORRECT_DISTANCE_M, color=drawing.BOUND, linestyle=":", linewidth=1)
        axes.set(xlabel="time (s)", ylabel="position error (m)", title=titles[task])
    drawing.log_metres(cumulative, "x")
    cumulative.set(
        xlabel="position error (m)", ylabel="share of scans with less", ylim=(0, 1), title="the half localised"
    )
    cumulative.legend(frameon=False, fontsize=9)
    if calibration is not None:
        calibration_curve(drawing.style_axes(panels[0, 1]), calibration)
    drawing.legend_below(figure, panels[1, 1])
    return figure
