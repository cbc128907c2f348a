"""Buildings: the floors' frames, geometry like that of each floor alone, files and their errors."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry.building import GAP_M, GRID_GAP_M
from common.geometry.floors import place_text
from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.rasterisation import rasterise
from common.geometry.world import World, load_world, save_world
from common.messages.requests import WorldReply
from tests.common.geometry.maps import HUT, ROOM, building, write_map

HALL = World(
    name="hall",
    boundary=[(-4, -3), (5, -3), (5, 2), (-4, 2)],
    obstacles=[{"name": "c", "circle": {"center": (2, 0), "radius": 0.4}}],
    start={"x": -2, "y": 1, "yaw_deg": 30},
)
ANGLES = np.linspace(-np.pi, np.pi, 40)


def grid_world(values, origin, resolution=0.5, name="map") -> World:
    return World.model_validate({"name": name, "grid": OccupancyGrid.of(values, resolution, origin)})


def files(folder, worlds, **more):
    """Writes a building whose floors are worlds; returns the path of its file."""
    for name, world in worlds.items():
        (folder / f"{name}.yaml").write_text(save_world(world))
    text = yaml.safe_dump(
        {"name": "tower", "floors": {name: f"{name}.yaml" for name in worlds}, **more}, sort_keys=False
    )
    path = folder / "tower.yaml"
    path.write_text(text)
    return str(path)


TOWER = building(ground=ROOM, first=HALL, second=ROOM)
GRIDS = {"ground": grid_world(HUT, (1.0, -2.0, 0.0)), "first": grid_world(HUT[:, ::-1], (-3.0, 0.6, 0.0))}
MAPPED = building(**GRIDS)
FLOORS = [
    *((TOWER, name, world) for name, world in (("ground", ROOM), ("first", HALL), ("second", ROOM))),
    *((MAPPED, name, world) for name, world in GRIDS.items()),
]


@pytest.mark.parametrize(("tower", "name", "alone"), FLOORS)
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_floor_is_like_the_floor_alone(tower, name, alone, seed):
    rng, floor = np.random.default_rng(seed), tower.floor(name)
    poses = alone.sample_poses(5, rng, 0.02)
    in_map = floor.to_map(poses)
    np.testing.assert_allclose(floor.from_map(in_map), poses, atol=1e-12)
    np.testing.assert_allclose(tower.to_map(poses, name), in_map)
    assert all(tower.floor_at(pose) == floor for pose in in_map)
    np.testing.assert_allclose(tower.clearance(in_map[:, :2]), alone.clearance(poses[:, :2]), atol=1e-9)
    reach = GRID_GAP_M if tower.grid else np.inf  # beyond it, a beam that has left a ROS map may meet the next one
    seen, expected = tower.ray_distances(in_map, ANGLES), alone.ray_distances(poses, ANGLES)
    np.testing.assert_allclose(np.where(seen < reach, seen, np.inf), expected, atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_places_between_floors(seed):
    points = np.random.default_rng(seed).uniform(TOWER.bounds[:2], TOWER.bounds[2:], (50, 2))
    free = TOWER.clearance(points) > 0
    assert all(TOWER.floor_at(point) is not None for point in points[free])
    between = [8 + GAP_M / 2, 3.0]
    assert TOWER.floor_at(between) is None
    assert TOWER.clearance([between])[0] < 0


@pytest.mark.parametrize(("tower", "floors"), [(TOWER, [ROOM, HALL, ROOM]), (MAPPED, list(GRIDS.values()))])
def test_free_area(tower, floors):
    assert tower.free_area == pytest.approx(sum(floor.free_area for floor in floors), rel=1e-9)


def test_first_floor_keeps_its_frame():
    assert TOWER.floors[0].offset == MAPPED.floors[0].offset == (0, 0)
    assert TOWER.floors[1].offset == (8 + GAP_M + 4, 0)
    assert [o.name for o in TOWER.obstacles[:4]] == ["ground/l", "ground/b", "ground/c", "first/c"]


def test_rasterised_building_is_closed():
    grid = rasterise(TOWER)
    columns = np.argwhere((grid.values == 0).any(axis=0)).ravel()
    assert (np.diff(columns) > 1).sum() == 2
    np.testing.assert_allclose((grid.values == 0).sum() * grid.resolution**2, TOWER.free_area, rtol=0.05)


def test_start():
    assert building(first=HALL, ground=ROOM).start == HALL.start
    assert building(ground=ROOM, first=HALL).start is None
    for tower in (building(ground=ROOM, first=HALL, second=HALL), MAPPED):  # near the middle of the first floor
        assert tower.floor_at(tower.start_pose(0.1)) == tower.floors[0]
    there = building(ground=ROOM, first=HALL, start={"floor": "first", "x": 1, "y": -1, "yaw_deg": 9})
    np.testing.assert_allclose(there.floor("first").from_map(there.start_pose(0.1)), [1, -1, np.deg2rad(9)])


def test_round_trips(tmp_path):
    lifts = [{"ground": [1, 5], "first": [1, 1]}]
    tower = load_world(files(tmp_path, {"ground": ROOM, "first": HALL}, lifts=lifts))
    assert [floor.name for floor in tower.floors] == ["ground", "first"]
    assert tower.lifts == [{"ground": (1, 5), "first": (1, 1)}]
    for each in (tower, MAPPED):
        (tmp_path / "saved.yaml").write_text(save_world(each))
        assert load_world(str(tmp_path / "saved.yaml")) == each
        assert WorldReply.decode(WorldReply(world=each).encode()).world == each
        assert each.with_obstacles(each.obstacles) == each
    plain = load_world("corridor").model_dump()
    assert list(plain) == ["name", "boundary", "obstacles", "start"]


def test_ros_maps_and_shipped_worlds_as_floors(tmp_path):
    (tmp_path / "maps").mkdir()
    for name, world in GRIDS.items():
        keys = {"resolution": 0.5, "origin": list(world.grid.origin), "free_thresh": 0.25}
        write_map(tmp_path / "maps", world.grid.values, name=name, image=f"{name}.pgm", **keys)
    path = tmp_path / "tower.yaml"
    path.write_text("{name: tower, floors: {ground: maps/ground.yaml, first: maps/first.yaml}}")
    assert load_world(str(path)) == MAPPED
    path.write_text("{name: tower, floors: {ground: office, first: corridor}}")
    assert load_world(str(path)).start == load_world("office").start


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"floors": {"ground": "nowhere.yaml"}}, "floor 'ground': no world"),
        ({"floors": {"ground": "ground.yaml", "all": "tower.yaml"}}, "floor 'all': a floor cannot be a building"),
        ({"floors": {"ground": "ground.yaml", "b": "saved.yaml"}}, "floor 'b' is itself a building"),
        ({"floors": {"ground": "ground.yaml", "b": "map.yaml"}}, "floor 'b': either all floors must be ROS maps"),
        (
            {"floors": {"a": "map.yaml", "b": "fine.yaml"}},
            "floor 'b': its resolution of 0.1 m differs from the 0.5 m of floor 'a'",
        ),
        ({"floors": {"a": "map.yaml", "b": "turned.yaml"}}, "floor 'b': its map is rotated"),
        ({"floors": {}}, "floors: too few entries: at least 1 are needed, not 0; an example is floors: {ground: "),
        ({"floors": None}, "floors: expected keys with values, not 'None'; an example is floors: {ground: "),
        ({"floors": "ground.yaml"}, "floors: expected keys with values, not 'ground.yaml'; an example"),
        ({"floors": ["ground.yaml"]}, "floors: expected keys with values, not \"['ground.yaml']\"; an example"),
        ({"floors": [{"ground": "ground.yaml"}]}, "floors: expected keys with values, not"),
        ({"floors": {"ground": {"x": 1}}}, "floors.ground: expected text, not \"{'x': 1}\"; an example"),
        ({"floors": {"ground floor": "ground.yaml"}}, "floors.ground floor: only letters, digits, '.', '-' and '_'"),
        ({"start": {"x": 1, "y": 1}}, "start.floor: missing; an example is start: {floor: ground, x"),
        ({"start": {"floor": "attic", "x": 1, "y": 1}}, "start: there is no floor 'attic': choose one of ground"),
        (
            {"start": {"floor": "ground", "x": 11, "y": 1}},
            "start: (11, 1) is not on floor 'ground', which reaches from (0, 0) to (8, 6) m",
        ),
        ({"lifts": {"ground": [1, 5], "first": [1, 5]}}, "lifts: expected a list, not"),
        (
            {"lifts": [{"ground": [1, 5]}]},
            "lifts, entry 1: too few entries: at least 2 are needed, not 1; an example is lifts: [{ground: [9, 1],",
        ),
        ({"lifts": [{"ground": [1, 5, 0], "b": [1, 5]}]}, "lifts, entry 1, ground: too many entries: at most 2 are"),
        ({"lifts": [{"ground": ["x", 5], "b": [1, 5]}]}, "lifts, entry 1, ground, entry 1: expected a number, not 'x'"),
        ({"lifts": [{"ground": [1, 5], "attic": [1, 5]}]}, "lift 1: there is no floor 'attic': choose one of ground"),
        (
            {"floors": {"a": "ground.yaml", "b": "ground.yaml"}, "lifts": [{"a": [1, 5], "b": [1, 50]}]},
            "lift 1: (1, 50) is not on floor 'b'",
        ),
        (
            {"floors": {"a": "ground.yaml", "b": "hall.yaml"}, "lifts": [{"a": [1, 5], "b": [2, 0]}]},
            "lift 1: (2, 0) is not in free space of floor 'b'",
        ),
        ({"boundary": [[0, 0], [1, 0], [1, 1]]}, "unknown key 'boundary'; the keys are floors, lifts, "),
    ],
)
def test_invalid_buildings(tmp_path, more, message):
    keys = {"resolution": 0.5, "origin": [0, 0, 0]}
    write_map(tmp_path, HUT, **keys)
    write_map(tmp_path, HUT, name="fine", **{**keys, "resolution": 0.1})
    write_map(tmp_path, HUT, name="turned", **{**keys, "origin": [0, 0, 0.5]})
    (tmp_path / "saved.yaml").write_text(save_world(TOWER))
    (tmp_path / "hall.yaml").write_text(save_world(HALL))
    path = files(tmp_path, {"ground": ROOM}, **more)
    with pytest.raises(UserError) as error:
        load_world(path)
    assert message in str(error.value)
    assert str(error.value).startswith(f"world {path}: ")


def test_numbered_floors_and_no_name(tmp_path):
    (tmp_path / "room.yaml").write_text(save_world(ROOM))
    (tmp_path / "tower.yaml").write_text("{floors: {0: room.yaml, 1: room.yaml}, lifts: [{0: [1, 5], 1: [1, 5]}]}")
    tower = load_world(str(tmp_path / "tower.yaml"))
    assert (tower.name, [floor.name for floor in tower.floors]) == ("tower", ["0", "1"])


def test_place_text():
    assert place_text(TOWER.floors, TOWER.to_map((-3.004, 0.5, 2), "first")) == "(-3.00, 0.50) on floor 'first'"
    assert place_text(TOWER.floors, TOWER.to_map((-1e-9, 0.5), "first"), decimals=1) == "(0.0, 0.5) on floor 'first'"
    assert place_text(TOWER.floors, (9, 1)) == "(9.00, 1.00)"
    assert "(-3.90, 0.00) on floor 'first' in tower is 0.10 m" in TOWER.placement_error(
        TOWER.to_map((-3.9, 0), "first"), 0.2
    )


@pytest.mark.parametrize("places", [[9, 1], [9, 1, 0.5], [[1, 1], [9, 1]]])
def test_place_beside_its_floor(places):
    with pytest.raises(
        UserError, match=r"\(9, 1\) is not on floor 'ground', which reaches from \(0, 0\) to \(8, 6\) m"
    ):
        TOWER.to_map(places, "ground")


def test_unknown_floor():
    with pytest.raises(UserError, match="no floor 'attic': choose one of ground, first, second"):
        TOWER.to_map([0, 0, 0], "attic")
    with pytest.raises(UserError, match="world 'room' has no floors"):
        ROOM.floor("ground")
