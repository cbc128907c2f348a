"""Draws worlds and ROS maps."""

from __future__ import annotations

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D

from common.geometry.occupancy_grid import OCCUPIED, UNKNOWN, OccupancyGrid
from common.geometry.world import World

UNKNOWN_COLOUR = "#E4E4E4"
WALL_THICKNESS_M = 0.12  # as drawn


def draw_walls(axes: Axes, world: World, wall: str) -> None:
    """Draws a ROS map, or the walls of a world in the colour ``wall``, below everything else; axes in m."""
    if world.grid is not None:
        draw_cells(axes, world.grid, wall)
        return
    for ring in world.wall_rings:
        outside = shapely.Polygon(ring).buffer(WALL_THICKNESS_M, join_style="mitre")
        axes.add_patch(Polygon(shapely.get_coordinates(outside.exterior), facecolor=wall, edgecolor="none", zorder=0.1))
        axes.add_patch(Polygon(ring, closed=True, facecolor="white", edgecolor="none", zorder=0.2))


def draw_cells(axes: Axes, grid: OccupancyGrid, wall: str) -> None:
    """Draws occupied cells in the colour ``wall``, unknown grey and free white, below everything else; axes in m."""
    kinds = np.select([grid.values == OCCUPIED, grid.values == UNKNOWN], [1, 2], 0)
    place = Affine2D().scale(grid.resolution).rotate(grid.origin[2]).translate(*grid.origin[:2])
    image = axes.imshow(
        kinds,
        cmap=ListedColormap(["white", wall, UNKNOWN_COLOUR]),
        vmin=0,
        vmax=2,
        origin="lower",
        aspect="equal",
        interpolation="nearest",
        extent=(0, grid.width, 0, grid.height),
        zorder=0.2,
    )
    image.set_transform(place + axes.transData)
