"""Writes occupancy grids as ROS maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, Cells

DEFAULT_KEYS = {
    "resolution": 0.05,
    "origin": [0.0, 0.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}
ROOM_WIDTH_M, DOOR_WIDTH_M = 6.0, 1.2


def rooms(size: int, seed: int = 0, cell: float = 0.05) -> Cells:
    """A random grid (size, size) of square rooms with doors and boxes, surrounded by unknown cells; ``cell`` in m."""
    rng = np.random.default_rng(seed)
    values = np.full((size, size), UNKNOWN, np.uint8)
    edge, room, door = size // 50, round(ROOM_WIDTH_M / cell), round(DOOR_WIDTH_M / cell)
    lines = range(edge, size - edge + 1, room)
    last = lines[-1]
    values[edge:last, edge:last] = FREE
    for line in lines:
        values[line - 2 : line + 2, edge - 2 : last + 2] = values[edge - 2 : last + 2, line - 2 : line + 2] = OCCUPIED
    for line in lines[1:-1]:
        for begin in lines[:-1]:
            for walls in (values, values.T):
                gap = begin + rng.integers(door, room - 2 * door)
                walls[line - 2 : line + 2, gap : gap + door] = FREE
    for _ in range(size**2 // 2000):
        (x, y), (w, h) = rng.integers(edge + 8, last - 8, 2), rng.integers(1, 10, 2)
        values[y : min(y + h, last), x : min(x + w, last)] = OCCUPIED
    return values


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
