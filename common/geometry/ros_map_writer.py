"""Writes occupancy grids as ROS maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from common.geometry.occupancy_grid import FREE, OCCUPIED, Cells, OccupancyGrid

DEFAULT_KEYS = {
    "resolution": 0.05,
    "origin": [0.0, 0.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write_grid(folder: Path, name: str, grid: OccupancyGrid) -> Path:
    """Writes a grid as NAME.yaml and NAME.pgm; returns the path of NAME.yaml."""
    keys = {"resolution": grid.resolution, "origin": list(grid.origin)}
    return write_map(folder, grid.values, name=name, image=f"{name}.pgm", **keys)


def write_map(folder: Path, values: Cells, *, name: str = "map", image: str = "map.pgm", **keys: Any) -> Path:
    """Writes map.yaml and its image as ROS map_saver does; returns the path of map.yaml.

    ``values`` has the shape (rows, columns), with the lowest row first; ``keys`` replace the defaults in map.yaml.
    """
    from PIL import Image  # needed only to write a map

    grey = np.select([values == FREE, values == OCCUPIED], [254, 0], 205)
    Image.fromarray(grey[::-1].astype(np.uint8)).save(folder / image)
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({"image": image, **DEFAULT_KEYS, **keys}), encoding="utf-8")
    return path
