"""The benchmark of a map that follows changes."""

from __future__ import annotations

import numpy as np

from lab.accuracy.scenes import Scene
from lab.benchmarks.visits import contains, drive_through_rooms, move_furniture_in
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
