"""Worlds and ROS maps for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from common.geometry.building import BuildingFile, lay_out
from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from common.geometry.ros_map_writer import DEFAULT_KEYS, write_map
from common.geometry.world import World
from lab.benchmarks.maps import rooms

__all__ = ["HUT", "ROOM", "TURNED", "building", "rooms", "speckled", "values_of", "write_map", "write_yaml"]

MARKS = {".": FREE, "#": OCCUPIED, "?": UNKNOWN}
TURNED = (1.0, -2.0, 0.6)  # origin of a grid that is rotated in map
ROOM = World(
    name="room",
    boundary=[(0, 0), (8, 0), (8, 5), (4, 5), (4, 6), (0, 6)],
    obstacles=[
        {"name": "l", "polygon": [(1, 1), (3, 1), (3, 1.5), (1.5, 1.5), (1.5, 3), (1, 3)]},
        {"name": "b", "box": {"center": (6, 2), "size": (1, 0.5), "yaw_deg": 30}},
        {"name": "c", "circle": {"center": (3, 4.5), "radius": 0.6}},
    ],
)


def building(lifts=(), start=None, **floors: World) -> World:
    """A building of these floors."""
    file = BuildingFile(name="tower", floors=dict.fromkeys(floors, ""), lifts=list(lifts), start=start)
    return World.model_validate(lay_out(file, floors))


def values_of(drawing):
    """(rows, columns) cells, lowest row first, from lines of text with the highest row first."""
    lines = drawing.split()
    return np.array([[MARKS[mark] for mark in line] for line in reversed(lines)], np.uint8)


HUT = values_of("""
    ??????????
    ?########?
    ?#......#?
    ?#.##...#?
    ?#.##...#.
    ?#......#.
    ?####.###?
    ?????.????
""")


def speckled(seed, size=9):
    """Random cells, which touch in every possible way."""
    rng = np.random.default_rng(seed)
    return rng.choice([FREE, OCCUPIED, UNKNOWN], (size, size + 3), p=[0.6, 0.25, 0.15]).astype(np.uint8)


def write_yaml(folder: Path, *, name="map", **keys) -> Path:
    """Writes map.yaml without an image."""
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(DEFAULT_KEYS | keys))
    return path
