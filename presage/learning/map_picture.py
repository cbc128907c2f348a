"""Draws a map and the path of the robot in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from common.geometry.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from common.geometry.se2 import Array
from presage.plotting.style import empty_figure


def draw_map(png: Path, grid: OccupancyGrid, poses: Array) -> None:
    """Draws a grid with a yaw of 0, and the places of poses (N, 3)."""
    values, rows, columns = grid.values, grid.height, grid.width
    size = 12 / max(rows, columns)
    figure = empty_figure(max(4, columns * size), max(4, rows * size))
    axes = figure.subplots()
    grey = np.select([values == FREE, values == OCCUPIED], [1.0, 0.0], 0.8)
    (x0, y0), (x1, y1) = grid.corners()[0], grid.corners()[2]
    axes.imshow(grey, origin="lower", extent=(x0, x1, y0, y1), cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
    axes.plot(poses[:, 0], poses[:, 1], color="#0072B2", linewidth=0.6)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    figure.savefig(png, dpi=150)
