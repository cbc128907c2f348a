"""Worlds: free space, clearance compared with shapely, the shipped worlds, and files."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import example, given
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry.world import World, known_worlds, lack_of_room, load_world, save_world
from common.robot.robot import Robot
from services.controller.policies.geodesic_field import WALL_GAP_M
from tests.common.geometry.maps import ROOM


@given(st.integers(0, 2**32 - 1))
def test_clearance(seed):
    rng = np.random.default_rng(seed)
    boxes = [{"box": {"center": rng.uniform(1, 9, 2).tolist(), "size": (0.5, 0.3), "yaw_deg": 20}} for _ in range(12)]
    world = World(name="w", boundary=[(0, 0), (10, 0), (10, 10), (0, 10)], obstacles=boxes)
    points = rng.uniform(-1, 11, (50, 2))
    where = shapely.points(points)
    distance = shapely.distance(where, shapely.boundary(world.free_space))
    inside = shapely.contains(world.free_space, where)
    np.testing.assert_allclose(world.clearance(points), np.where(inside, distance, -distance), atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.5))
@example(1025, 0.5)
def test_space_with_clearance(seed, clearance):
    """It contains the points that are so far from the edge of free space, also where obstacles overlap."""
    rng = np.random.default_rng(seed)
    boxes = [{"box": {"center": rng.uniform(0, 6, 2).tolist(), "size": (1.0, 0.5), "yaw_deg": 30}} for _ in range(8)]
    disc = {"circle": {"center": (3.0, 3.0), "radius": 0.5}}
    world = World(name="w", boundary=[(0, 0), (6, 0), (6, 4), (4, 4), (4, 6), (0, 6)], obstacles=[*boxes, disc])
    points = shapely.points(rng.uniform(0, 6, (2000, 2)))
    away = shapely.distance(shapely.boundary(world.free_space), points) * shapely.contains(world.free_space, points)
    # GEOS draws circles with 32 corners, and simplifies shapes by a hundredth of the distance before it widens them.
    decided = np.abs(away - clearance) > 0.02 * clearance
    found = shapely.contains(world.space_with_clearance(clearance), points)
    assert (found == (away > clearance))[decided].all()
    assert decided.mean() > 0.9


def test_no_free_space():
    everything = {"box": {"center": (1.0, 1.0), "size": (9.0, 9.0)}}
    full = World(name="w", boundary=[(0, 0), (2, 0), (2, 2), (0, 2)], obstacles=[everything])
    assert (full.clearance([[1.0, 1.0], [5.0, 5.0]]) < 0).all()


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.4))
def test_samples(seed, clearance):
    points = ROOM.sample_free(20, np.random.default_rng(seed), clearance)
    assert (ROOM.clearance(points) >= clearance).all()
    assert np.array_equal(points, ROOM.sample_free(20, np.random.default_rng(seed), clearance))


@given(st.integers(0, 2**32 - 1))
def test_samples_within_walls(seed):
    """Their density is the same in free space and in obstacles."""
    column = {"circle": {"center": (1.0, 1.0), "radius": 0.5}}
    world = World(name="w", boundary=[(0, 0), (2, 0), (2, 2), (0, 2)], obstacles=[column])
    points = world.sample_within_walls(2000, np.random.default_rng(seed))
    assert points.shape == (2000, 2)
    assert ((points > 0) & (points < 2)).all()
    share = np.pi * 0.5**2 / 4
    assert (world.clearance(points) < 0).mean() == pytest.approx(share, abs=5 * np.sqrt(share / 2000))


def test_no_room_for_samples():
    with pytest.raises(UserError, match="no place 4 m clear"):
        ROOM.sample_free(1, np.random.default_rng(0), 4)


def test_default_start_pose():
    start = ROOM.start_pose(0.3)
    assert ROOM.clearance(start[:2])[0] >= 0.3 - 1e-9
    assert np.hypot(*(start[:2] - ROOM.center())) < 1


@pytest.mark.parametrize("name", known_worlds())
def test_shipped_worlds_are_connected(name):
    world = load_world(name)
    room = shapely.buffer(world.free_space, -(Robot().radius + WALL_GAP_M))
    assert room.geom_type == "Polygon"
    assert room.contains(shapely.Point(world.start_pose(0)[:2]))
    assert world.name == name
    assert all(o.name for o in world.obstacles)
    assert all(not o.shape().disjoint(shapely.Polygon(world.boundary)) for o in world.obstacles)


def test_corridor():
    world = load_world("corridor")
    assert world.bounds == (0, 0, 18, 4.5)  # as in the paper
    along = np.column_stack([np.linspace(0.5, 17.5, 100), np.full(100, 1.5)])
    assert (world.clearance(along) > 0.45).all()  # the middle is free
    assert all(o.shape().bounds[1] > 3 for o in world.obstacles)  # all along one wall


def test_saved_world(tmp_path):
    (tmp_path / "w.yaml").write_text(save_world(ROOM))
    assert load_world(str(tmp_path / "w.yaml")) == ROOM


def test_name_defaults_to_that_of_the_file(tmp_path):
    path = tmp_path / "my room.yaml"
    path.write_text("boundary: [[0, 0], [1, 0], [1, 1]]")
    assert load_world(str(path)).name == "my-room"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: [", "not valid YAML"),
        ("floors:\n  ground: a.yaml\n  ground: b.yaml\n", "not valid YAML (line 3: 'ground' is given twice)"),
        ("[" * 200_000, "bad.yaml: more than 100 levels"),
        ("obstacles:\n" + "- {}\n" * 600_000, "bad.yaml: more than 1000000 values"),
        ("name: x", "boundary: missing"),
        ("{name: x, boundary: [[0, 0], [1, 1]]}", "at least 3"),
        ("{name: x, boundary: [[0, 0], [2, 2], [2, 0], [0, 2]]}", "not simple"),
        ("{name: x, boundary: [[0, 0], [1, 0], [.nan, 1]]}", "finite"),
        ("{name: x, boundary: [[0, 0], [600, 0], [600, 400], [0, 400]]}", "0.24 km², but a floor has at most 0.2 km²"),
        ("{name: x, boundary: [[0, 0], [1, 0], [1, 1]], obstacles: [{}]}", "exactly one of"),
        ("{name: x, boundary: [[0, 0], [1, 0], [1, x]]}", "boundary, entry 3, entry 2: expected a number, not 'x'"),
        ("{name: x, boundary: [[0, 0], [1, 0], [1, 1]], walls: 3}", "unknown key 'walls'; the keys are boundary, "),
        ("{boundary: [[0, 0], [1, 0], [1, 1]], obstacle: []}", "unknown key 'obstacle'; did you mean 'obstacles'?"),
        (
            "{boundary: [[0, 0], [1, 0], [1, 1]], obstacles: [{circle: {centre: [0, 0], radius: 1}}]}",
            "obstacles, entry 1, circle: unknown key 'centre'; did you mean 'center'?",
        ),
        (
            "{boundary: [[0, 0], [1, 0], [1, 1]], obstacles: [&a {name: a, circle: {center: [0, 0], radius: 1}}, *a]}",
            "two obstacles are named 'a'; give each a name of its own",
        ),
        (
            "{boundary: [[0, 0], [1, 0], [1, 1]], obstacles: [{name: boundary, circle: {center: [0, 0], radius: 1}}]}",
            "an obstacle is named 'boundary', as the walls are; give it another name",
        ),
        ("{name: ../x, boundary: [[0, 0], [1, 0], [1, 1]]}", "name: only letters, digits"),
        ("3", "file"),
        ("{name: x, since: 2020-13-45}", "month"),
    ],
)
def test_invalid_files(tmp_path, text, message):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        load_world(str(path))
    assert message in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_place_on_a_corner():
    assert lack_of_room(-0.0, 0.3) == "is 0.00 m from a wall, and the robot needs 0.3 m around it"


def test_unknown_world():
    with pytest.raises(UserError, match="corridor, maze, office, twins"):
        load_world("nowhere")
