"""Worlds: exact rays compared with ranges computed by hand and by shapely, free space, and files."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import World, known_worlds, load_world, save_world
from common.robot.base import Robot
from common.robot.scanner import SCANNERS

ROOM = World(
    name="room",
    boundary=[(0, 0), (8, 0), (8, 5), (4, 5), (4, 6), (0, 6)],
    obstacles=[
        {"name": "l", "polygon": [(1, 1), (3, 1), (3, 1.5), (1.5, 1.5), (1.5, 3), (1, 3)]},
        {"name": "b", "box": {"center": (6, 2), "size": (1, 0.5), "yaw_deg": 30}},
        {"name": "c", "circle": {"center": (3, 4.5), "radius": 0.6}},
    ],
)


def test_known_ranges():
    here = [[5.0, 4.0, 0.0]]
    assert ROOM.ray_distances(here, [0, np.pi / 2, -np.pi / 2]) == pytest.approx(np.array([[3.0, 1.0, 4.0]]))
    assert ROOM.ray_distances([[5.0, 4.5, np.pi]], [0.0])[0, 0] == pytest.approx(1.4)  # the circle
    assert ROOM.ray_distances([[0.5, 2.0, 0.0]], [0.0])[0, 0] == pytest.approx(0.5)


def test_rays_that_hit_nothing_are_infinite():
    assert np.isposinf(ROOM.ray_distances([[20.0, 3.0, 0.0]], [0.0])).all()


@given(st.integers(0, 2**32 - 1))
def test_rays_agree_with_shapely(seed):
    """A ray ends at a surface and meets none before."""
    rng = np.random.default_rng(seed)
    (x, y), angle = ROOM.sample_free(1, rng, 0.01)[0], rng.uniform(-np.pi, np.pi)
    distance = float(ROOM.ray_distances([[x, y, 0.0]], [angle])[0, 0])
    end = shapely.Point(x + distance * np.cos(angle), y + distance * np.sin(angle))
    assert shapely.distance(shapely.boundary(ROOM.free_space), end) < 1e-3  # the circle is many-sided in free space
    short = 0.999 * distance - 1e-3
    if short > 0:
        line = shapely.LineString([(x, y), (x + short * np.cos(angle), y + short * np.sin(angle))])
        assert ROOM.free_space.buffer(1e-3).contains(line)


def test_batches_of_poses_agree_with_single_poses():
    rng = np.random.default_rng(0)
    poses = np.column_stack([ROOM.sample_free(50, rng), rng.uniform(-3, 3, 50)])
    angles = np.linspace(-2, 2, 811)
    together = ROOM.ray_distances(poses, angles)
    assert np.array_equal(together, np.concatenate([ROOM.ray_distances(pose, angles) for pose in poses]))
    assert ROOM.ray_distances(np.zeros((0, 3)), angles).shape == (0, 811)


def test_clearance_is_negative_outside_free_space():
    inside, wall, outside = ROOM.clearance([[5, 4], [3, 4.5], [7, 5.5]])
    assert inside == pytest.approx(1.0)
    assert wall == pytest.approx(-0.6, abs=1e-3)
    assert outside < 0


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.4))
def test_samples_are_free_and_seeded(seed, clearance):
    points = ROOM.sample_free(20, np.random.default_rng(seed), clearance)
    assert (ROOM.clearance(points) >= clearance).all()
    assert np.array_equal(points, ROOM.sample_free(20, np.random.default_rng(seed), clearance))


def test_missing_room_is_an_error():
    with pytest.raises(UserError, match="no place 4 m clear"):
        ROOM.sample_free(1, np.random.default_rng(0), 4)


def test_the_default_start_is_near_the_centre():
    start = ROOM.start_pose(0.3)
    assert ROOM.clearance(start[:2])[0] >= 0.3 - 1e-9
    assert np.hypot(*(start[:2] - ROOM.center())) < 1


@pytest.mark.parametrize("name", known_worlds())
def test_shipped_worlds_are_connected_for_the_robot(name):
    world = load_world(name)
    room = shapely.buffer(world.free_space, -(Robot().radius + Robot().margin))
    assert room.geom_type == "Polygon"
    assert room.contains(shapely.Point(world.start_pose(0)[:2]))
    assert world.name == name
    assert all(o.name for o in world.obstacles)
    assert all(not o.shape().disjoint(shapely.Polygon(world.boundary)) for o in world.obstacles)


def test_the_corridor_has_the_papers_size():
    world = load_world("corridor")
    assert world.bounds == (0, 0, 18, 4.5)
    along = np.column_stack([np.linspace(0.5, 17.5, 100), np.full(100, 1.5)])
    assert (world.clearance(along) > 0.45).all()  # the middle is free
    assert all(o.shape().bounds[1] > 3 for o in world.obstacles)  # all along one wall


def test_twin_rooms_differ_only_at_the_corridor():
    """Scans of most of a room equal those of its twin; from the doorway on, a fifth of the beams differ."""
    world, scanner, twin = load_world("twins"), SCANNERS["tim571"].with_beams(271), np.array([6.0, 0, 0])

    def differ(poses):
        scans = [
            world.ray_distances(se2.compose(each, scanner.mount), scanner.angles()) for each in (poses, poses + twin)
        ]
        return (np.abs(scans[0] - scans[1]) > 3 * scanner.sigma).mean(axis=1)

    rng = np.random.default_rng(0)
    places = world.sample_free(600, rng, Robot().radius)
    places = places[(places[:, 0] < 5.8) & (places[:, 1] < 4.4)]
    assert (differ(np.column_stack([places, rng.uniform(-np.pi, np.pi, len(places))])) == 0).mean() > 0.75
    assert differ(np.array([[2.0, 2.2, yaw] for yaw in np.linspace(-3, 3, 7)])).max() == 0
    assert differ(np.array([[2.95, y, np.pi / 2] for y in (4.5, 4.8, 5.4)])).min() > 0.2


def test_saved_worlds_can_be_loaded(tmp_path):
    path = tmp_path / "w.yaml"
    path.write_text(save_world(ROOM))
    assert load_world(str(path)) == ROOM


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("name: [", "not valid YAML"),
        ("[" * 200_000, "bad.yaml: more than 100 levels"),
        ("obstacles:\n" + "- {}\n" * 600_000, "bad.yaml: more than 1000000 values"),
        ("name: x", "boundary: Field required"),
        ("{name: x, boundary: [[0, 0], [1, 1]]}", "at least 3"),
        ("{name: x, boundary: [[0, 0], [2, 2], [2, 0], [0, 2]]}", "not simple"),
        ("{name: x, boundary: [[0, 0], [1, 0], [.nan, 1]]}", "finite"),
        ("{name: x, boundary: [[0, 0], [1, 0], [1, 1]], obstacles: [{}]}", "exactly one of"),
        ("{name: x, boundary: [[0, 0], [1, 0], [1, 1]], walls: 3}", "walls"),
        ("{name: ../x, boundary: [[0, 0], [1, 0], [1, 1]]}", "name"),
        ("3", "file"),
        ("{name: x, since: 2020-13-45}", "month"),
    ],
)
def test_invalid_files_are_explained_in_one_line(tmp_path, text, why):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        load_world(str(path))
    assert why in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_world_lists_the_known_ones():
    with pytest.raises(UserError, match="corridor, maze, office, twins"):
        load_world("nowhere")


@given(st.integers(0, 2**32 - 1))
def test_clearance_is_the_distance_to_the_nearest_edge(seed):
    rng = np.random.default_rng(seed)
    boxes = [{"box": {"center": rng.uniform(1, 9, 2).tolist(), "size": (0.5, 0.3), "yaw_deg": 20}} for _ in range(12)]
    world = World(name="w", boundary=[(0, 0), (10, 0), (10, 10), (0, 10)], obstacles=boxes)
    points = rng.uniform(-1, 11, (50, 2))
    where = shapely.points(points)
    distance = shapely.distance(where, shapely.boundary(world.free_space))
    inside = shapely.contains(world.free_space, where)
    np.testing.assert_allclose(world.clearance(points), np.where(inside, distance, -distance), atol=1e-12)


def test_a_world_without_free_space_has_no_clearance():
    everything = {"box": {"center": (1.0, 1.0), "size": (9.0, 9.0)}}
    full = World(name="w", boundary=[(0, 0), (2, 0), (2, 2), (0, 2)], obstacles=[everything])
    assert (full.clearance([[1.0, 1.0], [5.0, 5.0]]) < 0).all()
