"""ROS maps that tests write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from common.occupancy_grid import FREE, OCCUPIED, UNKNOWN

MARKS = {".": FREE, "#": OCCUPIED, "?": UNKNOWN}
GREYS = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}  # map_saver's


def values_of(drawing):
    """(rows, columns), the lowest row first, of lines of text, the highest first."""
    lines = drawing.split()
    return np.array([[MARKS[mark] for mark in line] for line in reversed(lines)], np.uint8)


def write_map(folder: Path, values, *, name="map", image="map.pgm", **keys) -> Path:
    """map.yaml and its image, as map_saver writes them."""
    grey = np.select([values == FREE, values == OCCUPIED], [GREYS[FREE], GREYS[OCCUPIED]], GREYS[UNKNOWN])
    Image.fromarray(grey[::-1].astype(np.uint8)).save(folder / image)
    return write_yaml(folder, name=name, image=image, **keys)


def write_yaml(folder: Path, *, name="map", **keys) -> Path:
    """map.yaml alone."""
    described = {
        "resolution": 0.05,
        "origin": [0.0, 0.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.25,
    }
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(described | keys))
    return path


def rooms(size: int, seed: int = 0, cell: float = 0.05):
    """(size, size) of rooms six metres wide with doors, cupboards, and crumbs that stand about; unknown around them."""
    rng = np.random.default_rng(seed)
    values = np.full((size, size), UNKNOWN, np.uint8)
    edge, wide, door = size // 50, round(6 / cell), round(1.2 / cell)
    lines = range(edge, size - edge + 1, wide)
    last = lines[-1]
    values[edge:last, edge:last] = FREE
    for line in lines:
        values[line - 2 : line + 2, edge - 2 : last + 2] = values[edge - 2 : last + 2, line - 2 : line + 2] = OCCUPIED
    for line in lines[1:-1]:
        for begin in lines[:-1]:
            for walls in (values, values.T):
                gap = begin + rng.integers(door, wide - 2 * door)
                walls[line - 2 : line + 2, gap : gap + door] = FREE
    for _ in range(size**2 // 2000):
        (x, y), (w, h) = rng.integers(edge + 8, last - 8, 2), rng.integers(1, 10, 2)
        values[y : min(y + h, last), x : min(x + w, last)] = OCCUPIED
    return values
