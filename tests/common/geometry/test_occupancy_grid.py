"""Occupancy grids as data, and their geometry compared with polygons, brute force and values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from common.errors import UserError
from common.geometry import segment_rays
from common.geometry.cell_distance import signed_distance
from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, outline
from common.geometry.world import World, load_world, save_world
from tests.common.geometry.maps import rooms, values_of

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
TURNED = (1.0, -2.0, 0.6)


def world_of(values, resolution=0.5, origin=(0.0, 0.0, 0.0), **more):
    return World(name="hut", grid=OccupancyGrid.of(values, resolution, origin), **more)


def speckled(seed, size=9):
    """Random cells, which touch in every possible way."""
    rng = np.random.default_rng(seed)
    return rng.choice([FREE, OCCUPIED, UNKNOWN], (size, size + 3), p=[0.6, 0.25, 0.15]).astype(np.uint8)


def squares(values, kind, world):
    """The cells with one value as separate polygons in map."""
    row, column = np.nonzero(values == kind)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    rings = np.column_stack([column, row])[:, None] + corners
    size = world.grid.resolution
    return shapely.union_all(shapely.polygons([world.grid.to_map(ring * size) for ring in rings]))


def test_ranges_computed_by_hand():
    hut = world_of(HUT)
    here = [[2.75, 1.25, 0.0]]  # in the cell above the door
    ahead = hut.ray_distances(here, [0.0, np.pi / 2, np.pi, -np.pi / 2])
    assert ahead == pytest.approx(np.array([[1.25, 1.75, 1.75, np.inf]]))  # through the door and off the map
    assert hut.ray_distances([[0.25, 3.25, 0.0]], [0.0]) == pytest.approx(0.25)  # unknown cells hide nothing
    assert hut.ray_distances([[-7.0, 3.25, 0.0]], [0.0]) == pytest.approx(7.5)  # from off the map
    assert np.isposinf(hut.ray_distances([[-7.0, 3.25, 0.0]], [np.pi, 1.5])).all()


def test_unknown_cells_are_not_free():
    hut = world_of(HUT)
    clearance = hut.clearance([[2.25, 1.25], [0.25, 0.25], [-3.0, 0.0], [0.75, 0.75], [4.75, 1.75]])
    assert clearance == pytest.approx([0.25, *clearance[1:4], 0.25])
    assert (clearance[1:4] < 0).all()  # unknown, off the map, in a wall
    places = hut.sample_free(500, np.random.default_rng(0), 0.2)
    assert hut.clearance(places).min() >= 0.2
    assert set(hut.grid.at(places)) == {FREE}
    with pytest.raises(UserError, match="no place 3"):
        hut.sample_free(1, np.random.default_rng(0), 3.0)
    with pytest.raises(UserError, match="no place 3"):
        hut.start_pose(3.0)


@given(st.integers(0, 2**32 - 1), st.sampled_from([(0.0, 0.0, 0.0), TURNED]))
def test_rays_agree_with_the_cells_outlines(seed, origin):
    values = speckled(seed)
    world = world_of(values, origin=origin)
    rng = np.random.default_rng(seed)
    poses = np.column_stack([world.grid.to_map(rng.uniform(-3, 11, (20, 2))), rng.uniform(-np.pi, np.pi, 20)])
    angles = np.linspace(-3, 3, 17)
    expected = segment_rays.distances(world.segments, world.circles, poses, angles)
    np.testing.assert_allclose(world.ray_distances(poses, angles), expected, atol=1e-9)
    assert shapely.length(shapely.boundary(squares(values, OCCUPIED, world))) == pytest.approx(
        np.hypot(*(world.segments[:, 2:] - world.segments[:, :2]).T).sum()
    )


@given(st.integers(0, 2**32 - 1), st.sampled_from([(0.0, 0.0, 0.0), TURNED]))
def test_free_space_and_clearance_follow_the_free_cells(seed, origin):
    values = speckled(seed)
    world = world_of(values, origin=origin, obstacles=[{"circle": {"center": (2.0, 3.0), "radius": 0.8}}])
    free = squares(values, FREE, world).difference(world.furniture)
    assert shapely.is_valid(world.free_space)
    assert shapely.area(shapely.symmetric_difference(free, world.free_space)) < 1e-9
    points = world.grid.to_map(np.random.default_rng(seed).uniform(-1, 9, (60, 2)))
    inside = shapely.contains(free, shapely.points(points))
    away = shapely.distance(shapely.points(points), shapely.boundary(free))
    np.testing.assert_allclose(world.clearance(points)[inside], away[inside], atol=1e-9)
    assert (world.clearance(points)[~inside] <= 0).all()


@given(st.integers(0, 2**32 - 1))
def test_lattice_distances_agree_with_single_points(seed):
    rng = np.random.default_rng(seed)
    world = world_of(speckled(seed), origin=(1.0, -2.0, 0.0))
    x, y = np.sort(rng.uniform(-1, 11, 12)), np.sort(rng.uniform(-5, 7, 9))
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(world.clearances(x, y).ravel(), world.clearance(nodes), atol=1e-9)
    away = np.clip(world.grid.shapes.distance(OCCUPIED, nodes), -0.7, 0.7)
    np.testing.assert_allclose(world.surface_distances(x, y, 0.7).ravel(), away, atol=1e-9)


def test_lattice_over_uniform_cells():
    x = np.array([-1.5, 0.5])
    assert np.isposinf(signed_distance(np.zeros((2, 2), bool), x, x)).all()
    assert signed_distance(np.ones((2, 2), bool), x, x) == pytest.approx(np.array([[1.5 * 2**0.5, 1.5], [1.5, -0.5]]))


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1.5))
def test_cells_with_clearance_have_clear_centres(seed, clearance):
    world = world_of(speckled(seed))
    cells = np.argwhere(world.grid.values == FREE)[:, ::-1]
    clear = world.clearance(world.grid.shapes.points_in_cells(cells, 0.5)) >= clearance
    assert world.grid.shapes.cells_with_clearance(clearance).tolist() == cells[clear].tolist()


def test_collinear_edges_are_merged():
    assert sorted(outline(np.ones((3, 5), bool)).tolist()) == [[0, 0, 0, 3], [0, 0, 5, 0], [0, 3, 5, 3], [5, 0, 5, 3]]
    touching = np.array([[True, False], [False, True]])  # two cells that touch with a corner: eight faces
    assert len(outline(touching)) == 8


def test_large_maps_are_compressed_and_fast():
    values = rooms(1000)
    world = world_of(values, 0.05, (-25.0, -25.0, 0.0))
    text = world.model_dump_json()
    assert len(text) < 60_000
    again = World.model_validate_json(text)
    assert np.array_equal(again.grid.values, values)
    assert again.grid.shapes is world.grid.shapes  # other furniture, the same map: nothing is computed twice
    poses = np.column_stack([world.sample_free(20, np.random.default_rng(1), 0.3), np.arange(20.0)])
    few = np.linspace(-2, 2, 20)
    brute = segment_rays.distances(world.segments, world.circles, poses, few)
    np.testing.assert_allclose(world.ray_distances(poses, few), brute, atol=1e-9)


def test_obstacles_on_a_map_hide_and_block():
    crate = {"name": "crate", "box": {"center": (2.75, 2.25), "size": (0.3, 0.3)}}
    hut, empty = world_of(HUT, obstacles=[crate]), world_of(HUT)
    here = [[2.75, 1.25, np.pi / 2]]
    assert hut.ray_distances(here, [0.0]) == pytest.approx(0.85)
    assert hut.clearance([2.75, 2.25])[0] < 0 < empty.clearance([2.75, 2.25])[0]
    assert len(hut.segments) == len(empty.segments) + 4
    assert np.array_equal(hut.with_obstacles([]).segments, empty.segments)


def test_saved_maps_are_loaded_unchanged(tmp_path):
    hut = world_of(
        HUT, origin=TURNED, start={"x": 1.0, "y": 0.0}, obstacles=[{"circle": {"center": (0, 0), "radius": 1}}]
    )
    path = tmp_path / "hut.yaml"
    path.write_text(save_world(hut))
    assert load_world(str(path)) == hut
    assert "grid" not in load_world("corridor").model_dump()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"cells": "?"}, "not base64 of zlib"),
        ({"cells": "AAAA"}, "not base64 of zlib"),
        ({"width": 11}, "not 11 x 8 bytes"),
        ({"height": 7}, "not 10 x 7 bytes"),
        ({"width": 10_000, "height": 10_000}, "more than"),
        ({"resolution": 0.0}, "greater than 0"),
        ({"origin": (0, float("nan"), 0)}, "finite"),
    ],
)
def test_invalid_grids_are_refused(change, why):
    plain = OccupancyGrid.of(HUT, 0.5, (0, 0, 0)).model_dump()
    with pytest.raises(ValidationError, match=why):
        World.model_validate({"name": "bad", "grid": plain | change})


def test_cells_have_three_values_and_the_boundary_is_the_grids_edge():
    with pytest.raises(ValidationError, match="100 occupied"):
        OccupancyGrid.of(np.full((2, 2), 7, np.uint8), 0.5, (0, 0, 0))
    with pytest.raises(ValidationError, match="leave it out"):
        world_of(HUT, boundary=[(0, 0), (1, 0), (1, 1)])
