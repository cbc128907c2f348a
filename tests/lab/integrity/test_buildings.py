"""Generated buildings, and their differences from the map."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from lab.accuracy.scenes import ROBOT, Scene
from lab.integrity import changes
from lab.integrity.buildings import make_building
from lab.integrity.maps import scaled_map

OFFICES = [make_building(seed) for seed in range(4)]
KINDS = [*OFFICES, make_building(0, "symmetric"), make_building(0, "corridor")]


def passable(world):
    return shapely.buffer(world.free_space, -ROBOT.radius)


@pytest.mark.parametrize("building", KINDS, ids=lambda b: b.name)
def test_every_room_reachable(building):
    area = passable(building.world)
    assert area.geom_type == "Polygon"
    for room in building.rooms:
        own = room.box(room.width / 2, room.depth / 2, (room.width, room.depth)).shape()
        assert shapely.area(shapely.intersection(area, own)) > 0.5


@pytest.mark.parametrize("building", KINDS, ids=lambda b: b.name)
def test_outer_walls_closed(building):
    poses = Scene.of(building.world, 60, 0).poses(20)
    ranges = building.world.ray_distances(poses, np.linspace(-np.pi, np.pi, 90))
    x0, y0, x1, y1 = building.world.bounds
    assert ranges.max() <= np.hypot(x1 - x0, y1 - y0)


def test_same_building_for_same_seed():
    assert make_building(3).world == OFFICES[3].world
    assert make_building(4).world != OFFICES[3].world


@pytest.mark.parametrize("building", OFFICES, ids=lambda b: b.name)
def test_size_and_furniture(building):
    assert 80 <= shapely.area(shapely.Polygon(building.boundary)) <= 300
    assert len(building.furniture) > 2 * sum(room.door is not None for room in building.rooms)


def test_symmetric_rooms_alike():
    building = make_building(0, "symmetric")
    rooms = [room for room in building.rooms if room.door is not None]
    middles = np.array([room.box(room.width / 2, room.depth / 2, (1, 1)).box.center for room in rooms])
    counts = [
        sum(np.abs(np.array(piece.pose[:2]) - middle).max() < rooms[0].width / 2 for piece in building.furniture)
        for middle in middles
    ]
    assert len({(round(room.width, 6), round(room.depth, 6), round(room.door, 6)) for room in rooms}) == 1
    assert len(set(counts)) == 1


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_moved_furniture(share):
    before = OFFICES[2]
    after = changes.move_furniture(before, share, np.random.default_rng(0))
    kept = len(set(before.furniture) & set(after.furniture)) / len(before.furniture)
    assert kept == pytest.approx(1 - share, abs=0.2)
    assert len(after.furniture) >= 0.9 * len(before.furniture)
    assert passable(after.world).geom_type == "Polygon"


def test_added_and_removed_furniture():
    before, rng = OFFICES[1], np.random.default_rng(0)
    added = changes.add_furniture(before, 0.5, rng)
    removed = changes.remove_furniture(before, 0.5, rng)
    assert set(before.furniture) < set(added.furniture)
    assert set(removed.furniture) < set(before.furniture)


def test_closed_doors_separate_rooms():
    building = OFFICES[0]
    panels = changes.closed_doors(building, 1.0, np.random.default_rng(0))
    parts = shapely.get_parts(passable(building.world_with(panels)))
    assert len(parts) >= len(panels)


def test_people_walk():
    world = OFFICES[0].world
    path = np.tile(Scene.of(world, 60, 0).poses(1), (30, 1))
    discs = changes.crowd(world, path, 15.0, 4, np.random.default_rng(0))
    steps = np.hypot(*np.moveaxis(np.diff(discs[..., :2], axis=0), 2, 0))
    assert discs.shape == (30, 4, 3)
    assert 0 < steps.max() < 0.1


def test_surfaces_without_return():
    building, rng = OFFICES[0], np.random.default_rng(0)
    scene = Scene.of(building.world, 90, 0)
    poses = scene.poses(10)
    ranges = scene.world.ray_distances(poses, scene.scanner.angles())
    everything = [*changes.glass(building, 1.0, rng), *changes.black_furniture(building, 1.0, rng)]
    assert changes.hits(everything, ranges, poses, scene.scanner.angles()).all()
    assert not changes.hits([], ranges, poses, scene.scanner.angles()).any()


@pytest.mark.parametrize("kind", ["anywhere", "similar", "nearby"])
def test_kidnapping_places(kind):
    scene = Scene.of(OFFICES[0].world, 90, 0)
    places, pose = changes.KidnappingPlaces(scene, kind), scene.poses(1)[0]
    after = np.array([places.after(pose) for _ in range(5)])
    distance = np.hypot(*(after - pose)[:, :2].T)
    assert scene.world.clearance(after[:, :2]).min() >= ROBOT.radius
    assert ((distance > 0.5) & (distance < 2)).all() if kind == "nearby" else (distance > 1.5).all()


def test_similar_place_looks_alike():
    scene = Scene.of(make_building(0, "symmetric").world, 90, 0)
    pose = scene.poses(1)[0]
    here = scene.clean(pose[None])[0]

    def difference(other):
        return np.abs(np.minimum(scene.clean(other[None])[0], 10) - np.minimum(here, 10)).mean()

    similar = changes.KidnappingPlaces(scene, "similar").after(pose)
    assert difference(similar) < 0.5 * np.median([difference(other) for other in scene.poses(20)])


def test_scaled_map():
    world = OFFICES[0].world
    pose = np.array([[*world.sample_free(1, np.random.default_rng(0), 0.3)[0], 0.3]])
    angles = np.linspace(-2, 2, 30)
    larger = scaled_map(world, 1.01).ray_distances(pose * [1.01, 1.01, 1], angles)
    assert larger == pytest.approx(1.01 * world.ray_distances(pose, angles))
