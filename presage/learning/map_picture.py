"""Draws a map and the path of the robot in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from common.geometry.occupancy_grid import FREE, OCCUPIED, Cells
from common.geometry.se2 import Array


def draw_map(png: Path, values: Cells, origin: tuple[float, float], cell: float, poses: Array) -> None:
    """Draws cells (rows, columns) of ``cell`` m, and the places of poses (N, 3)."""
    rows, columns = values.shape
    size = 12 / max(rows, columns)
    figure = Figure(figsize=(max(4, columns * size), max(4, rows * size)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    grey = np.select([values == FREE, values == OCCUPIED], [1.0, 0.0], 0.8)
    extent = (origin[0], origin[0] + columns * cell, origin[1], origin[1] + rows * cell)
    axes.imshow(grey, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
    axes.plot(poses[:, 0], poses[:, 1], color="#0072B2", linewidth=0.6)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    figure.savefig(png, dpi=150)
