"""Writes ROS maps for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from presage.learning.grid_map import DEFAULT_KEYS, rooms, write_map

__all__ = ["rooms", "values_of", "write_map", "write_yaml"]

MARKS = {".": FREE, "#": OCCUPIED, "?": UNKNOWN}


def values_of(drawing):
    """(rows, columns) cells, lowest row first, from lines of text with the highest row first."""
    lines = drawing.split()
    return np.array([[MARKS[mark] for mark in line] for line in reversed(lines)], np.uint8)


def write_yaml(folder: Path, *, name="map", **keys) -> Path:
    """Write map.yaml without an image."""
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(DEFAULT_KEYS | keys))
    return path
