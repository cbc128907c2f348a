"""Occupancy grids from scans with known poses.

A cell is occupied if beams of at least `MIN_HITS` scans ended in it, and of at least `MIN_HIT_SHARE` of the scans that
observed it; otherwise it is free if a beam passed through it, and unknown if not. Beams mostly pass through the places
of moving objects, which therefore become free. Beams without return are not used.
"""

from __future__ import annotations

import numpy as np

from common.errors import UserError
from common.geometry import se2
from common.geometry.occupancy_grid import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, OccupancyGrid
from common.geometry.se2 import Array
from common.robot.ranges import is_surface
from common.robot.stray_beams import has_neighbours
from services.mapper.slam.cell_counts import count_scans
from services.mapper.slam.drive import Laser

# With a smaller share, noise makes walls grow towards the scanner; with a larger one, corners disappear.
MIN_HITS, MIN_HIT_SHARE = 2, 0.6
MARGIN_M = 0.5  # around the observed area


def grid_of_scans(
    poses: Array, ranges: Array, laser: Laser, cell: float, unseen: OccupancyGrid | None = None
) -> OccupancyGrid:
    """A grid of cells of edge length ``cell`` m from scans ``ranges`` (N, B) at base_link poses (N, 3).

    Cells that no beam observed are those of the grid ``unseen``, if given. Raises UserError if there are too many
    cells.
    """
    corner, rows, columns = _extent(poses, ranges, laser, cell, unseen)
    if columns * rows > MAX_CELLS:
        raise UserError(
            f"{columns} x {rows} cells are more than the maximum of {MAX_CELLS}: use a larger --cell than {cell:g} m"
        )
    x, y = corner.round(6).tolist()
    hits, passes = np.zeros((rows, columns), np.int64), np.zeros((rows, columns), np.int64)
    ranges = np.where(is_surface(ranges) & (ranges < laser.range_max), ranges, np.inf)
    count_scans(se2.compose(poses, laser.mount) - [x, y, 0.0], ranges, laser.angles, cell, hits, passes)
    occupied = (hits >= MIN_HITS) & (hits >= MIN_HIT_SHARE * (hits + passes))
    values = np.where(occupied, OCCUPIED, np.where(passes > 0, FREE, UNKNOWN)).astype(np.uint8)
    if unseen is not None:
        column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
        centres = np.stack([column, row], axis=-1).reshape(-1, 2) * cell + corner
        values = np.where(values == UNKNOWN, unseen.values_at(centres).reshape(rows, columns), values)
    return OccupancyGrid.of(values, cell, (x, y, 0.0))


def _extent(
    poses: Array, ranges: Array, laser: Laser, cell: float, unseen: OccupancyGrid | None
) -> tuple[Array, int, int]:
    """Lower left corner (2,) m, rows and columns of a grid over all that the scans saw, and over ``unseen``."""
    lasers = se2.compose(poses, laser.mount)
    row, beam = np.nonzero(is_surface(ranges))
    direction = lasers[row, 2] + laser.angles[beam]
    ends = lasers[row, :2] + ranges[row, beam][:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    seen = np.concatenate([ends[has_neighbours(ends)], poses[:, :2]])
    low, high = seen.min(axis=0) - MARGIN_M, seen.max(axis=0) + MARGIN_M
    if unseen is not None:
        corners = np.asarray(unseen.corners())
        low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
    corner = np.floor(low / cell) * cell
    columns, rows = (int(n) for n in np.ceil((high - corner) / cell))
    return corner, rows, columns
