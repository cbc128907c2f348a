"""The figure of `presage experiment real`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from common.se2 import Array
from common.world import World
from presage.drive_figure import calibration_curve
from presage.experiments import drawing
from presage.experiments.real_drive import LASER, NEAR_ENOUGH, ODOMETRY
from presage.map_drawing import draw_walls
from services.estimator.precise.weights import FieldCard


def draw(world: World, way: Array, card: FieldCard, rows: Sequence[dict[str, Any]], titles: dict[str, str]) -> Figure:
    """The map with the second half's way, calibration, errors over time with and without odometry."""
    figure = drawing.blank(14, 9)
    panels = figure.subplots(2, 2, width_ratios=(1.6, 1))
    draw_walls(panels[0, 0], world, "#222222")
    panels[0, 0].plot(*way[:, :2].T, color=drawing.MEASURED, linewidth=1, label="second half")
    panels[0, 0].set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="map of the first half")
    panels[0, 0].autoscale_view()
    if card.calibration is not None:
        calibration_curve(panels[0, 1], card.calibration)
    for axes, task in zip(panels[1], (ODOMETRY, LASER), strict=True):
        drawing.dress(axes)
        for row in rows:
            if row["task"] == task:
                stamps = np.array(row["stamp_s"]) - row["stamp_s"][0]
                axes.plot(
                    stamps, np.maximum(row["error_m"], 1e-3), linewidth=0.9, color=drawing.COLOURS[row["estimator"]],
                    label=row["estimator"],
                )  # fmt: skip
        drawing.log_metres(axes)
        axes.axhline(NEAR_ENOUGH, color=drawing.BOUND, linestyle=":", linewidth=1)
        axes.set(xlabel="time (s)", ylabel="position error (m)", title=titles[task])
    drawing.legend_below(figure, panels[1, 1])
    return figure
