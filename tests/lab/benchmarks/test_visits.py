"""The benchmark of a map that follows changes."""

from __future__ import annotations

import numpy as np

from lab.accuracy.scenes import Scene
from lab.benchmarks.building_drives import contains, drive_through_rooms
from lab.benchmarks.visits import MODELS, move_furniture_in, table
from lab.integrity.buildings import make_building


def test_furniture_moves_in_its_rooms_only():
    building = make_building(3)
    rooms = [room for room in building.rooms if room.door is not None]
    moved = move_furniture_in(building, rooms[:1], np.random.default_rng(0))
    stays = [piece for piece in building.furniture if not contains(rooms[0], np.array([piece.pose[:2]]))[0]]
    assert set(stays) <= set(moved.furniture)
    assert len(set(moved.furniture) - set(stays)) > 0
    assert not set(moved.furniture) >= set(building.furniture)


def test_drive_enters_all_rooms():
    building = make_building(3)
    scene = Scene.of(building.world, 100, 1)
    path = drive_through_rooms(scene, building, 1.0)
    assert all(contains(room, path[:, :2]).any() for room in building.rooms)
    assert building.world.clearance(path[:, :2]).min() > 0.2


def test_table_divides_rooms_by_what_the_drive_entered():
    row = {"visit": 2, "in_changed_room": [True, True, False], "in_entered_room": [True, False, True]}
    row |= {model: [0.001, None, 0.002] for model in MODELS}
    lines = table([{"visit": 1}, row]).splitlines()
    found = {cells[2].strip(): cells[3].strip() for cells in (line.split("|") for line in lines[2:6])}
    assert found == {
        "all": "2/3; 1.50",
        "changing, entered": "1/1; 1.00",
        "changing, not entered": "0/1; –",
        "unchanging": "1/1; 2.00",
    }
