"""Occupancy grids as data, and their geometry compared with polygons and values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from common.errors import UserError
from common.geometry.cell_distance import signed_distance
from common.geometry.occupancy_grid import FREE, OCCUPIED, OccupancyGrid, outline
from common.geometry.world import World, load_world, save_world
from tests.common.geometry.maps import HUT, TURNED, rooms, speckled

SEEDS, ORIGINS = st.integers(0, 2**32 - 1), st.sampled_from([(0.0, 0.0, 0.0), TURNED])


def world_of(values, resolution=0.5, origin=(0.0, 0.0, 0.0), **more):
    return World(name="hut", grid=OccupancyGrid.of(values, resolution, origin), **more)


def squares(kind, world):
    """The cells with one value as separate polygons in map."""
    row, column = np.nonzero(world.grid.values == kind)
    rings = np.column_stack([column, row])[:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    return shapely.union_all(shapely.polygons([world.grid.to_map(ring * world.grid.resolution) for ring in rings]))


def test_unknown_cells_are_not_free():
    hut = world_of(HUT)
    clearance = hut.clearance([[2.25, 1.25], [0.25, 0.25], [-3.0, 0.0], [0.75, 0.75], [4.75, 1.75]])
    assert clearance == pytest.approx([0.25, *clearance[1:4], 0.25])
    assert (clearance[1:4] < 0).all()  # unknown, off the map, in a wall
    places = hut.sample_free(500, np.random.default_rng(0), 0.2)
    assert hut.clearance(places).min() >= 0.2
    assert set(hut.grid.values_at(places)) == {FREE}
    for impossible in (lambda: hut.sample_free(1, np.random.default_rng(0), 3.0), lambda: hut.start_pose(3.0)):
        with pytest.raises(UserError, match="no place 3"):
            impossible()


@given(SEEDS, ORIGINS)
def test_geometry_of_cells(seed, origin):
    circle = {"circle": {"center": (2.0, 3.0), "radius": 0.8}}
    world, bare = (world_of(speckled(seed), origin=origin, obstacles=o) for o in ([circle], []))
    walls = np.hypot(*(bare.segments[:, 2:] - bare.segments[:, :2]).T).sum()
    assert shapely.length(shapely.boundary(squares(OCCUPIED, bare))) == pytest.approx(walls)
    free = squares(FREE, world).difference(world.furniture)
    assert shapely.is_valid(world.free_space)
    assert shapely.area(shapely.symmetric_difference(free, world.free_space)) < 1e-9
    points = world.grid.to_map(np.random.default_rng(seed).uniform(-1, 9, (60, 2)))
    inside = shapely.contains(free, shapely.points(points))
    away = shapely.distance(shapely.points(points), shapely.boundary(free))
    np.testing.assert_allclose(world.clearance(points)[inside], away[inside], atol=1e-9)
    assert (world.clearance(points)[~inside] <= 0).all()


@given(SEEDS)
def test_lattice_distances(seed):
    rng = np.random.default_rng(seed)
    world = world_of(speckled(seed), origin=(1.0, -2.0, 0.0))
    x, y = np.sort(rng.uniform(-1, 11, 12)), np.sort(rng.uniform(-5, 7, 9))
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(world.clearance_on_lattice(x, y).ravel(), world.clearance(nodes), atol=1e-9)
    away = np.clip(world.grid.geometry.distance(OCCUPIED, nodes), -0.7, 0.7)
    np.testing.assert_allclose(world.surface_distance_on_lattice(x, y, 0.7).ravel(), away, atol=1e-9)


def test_distances_to_uniform_cells():
    x = np.array([-1.5, 0.5])
    assert np.isposinf(signed_distance(np.zeros((2, 2), bool), x, x)).all()
    assert signed_distance(np.ones((2, 2), bool), x, x) == pytest.approx(np.array([[1.5 * 2**0.5, 1.5], [1.5, -0.5]]))


@given(SEEDS, st.floats(0.1, 1.5))
def test_cells_with_clearance(seed, clearance):
    world = world_of(speckled(seed))
    cells = np.argwhere(world.grid.values == FREE)[:, ::-1]
    clear = world.clearance(world.grid.geometry.points_in_cells(cells, 0.5)) >= clearance
    assert world.grid.geometry.cells_with_clearance(clearance).tolist() == cells[clear].tolist()


def test_merged_edges():
    assert sorted(outline(np.ones((3, 5), bool)).tolist()) == [[0, 0, 0, 3], [0, 0, 5, 0], [0, 3, 5, 3], [5, 0, 5, 3]]
    assert len(outline(np.eye(2, dtype=bool))) == 8  # two cells that touch at a corner


def test_large_map_as_message():
    world = world_of(rooms(1000), 0.05, (-25.0, -25.0, 0.0))
    text = world.model_dump_json()
    assert len(text) < 60_000
    again = World.model_validate_json(text)
    assert again == world
    assert again.grid.geometry is world.grid.geometry  # the same map: nothing is computed twice


def test_obstacles_on_a_map():
    crate = {"name": "crate", "box": {"center": (2.75, 2.25), "size": (0.3, 0.3)}}
    hut, empty = world_of(HUT, obstacles=[crate]), world_of(HUT)
    assert hut.ray_distances([[2.75, 1.25, np.pi / 2]], [0.0]) == pytest.approx(0.85)
    assert hut.clearance([2.75, 2.25])[0] < 0 < empty.clearance([2.75, 2.25])[0]
    assert len(hut.segments) == len(empty.segments) + 4
    assert np.array_equal(hut.with_obstacles([]).segments, empty.segments)


def test_saved_map(tmp_path):
    disc = {"circle": {"center": (0, 0), "radius": 1}}
    hut = world_of(HUT, origin=TURNED, start={"x": 1.0, "y": 0.0}, obstacles=[disc])
    (tmp_path / "hut.yaml").write_text(save_world(hut))
    assert load_world(str(tmp_path / "hut.yaml")) == hut
    assert "grid" not in load_world("corridor").model_dump()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cells": "?"}, "not zlib-compressed and base64-encoded"),
        ({"cells": "AAAA"}, "not zlib-compressed and base64-encoded"),
        ({"width": 11}, "not 11 x 8 bytes"),
        ({"height": 7}, "not 10 x 7 bytes"),
        ({"width": 10_000, "height": 10_000}, "more than"),
        ({"resolution": 0.0}, "greater than 0"),
        ({"origin": (0, float("nan"), 0)}, "finite"),
    ],
)
def test_invalid_grids(change, message):
    plain = OccupancyGrid.of(HUT, 0.5, (0, 0, 0)).model_dump()
    with pytest.raises(ValidationError, match=message):
        World.model_validate({"name": "bad", "grid": plain | change})


def test_invalid_cells_and_boundary():
    with pytest.raises(ValidationError, match=r"100 \(occupied\)"):
        OccupancyGrid.of(np.full((2, 2), 7, np.uint8), 0.5, (0, 0, 0))
    with pytest.raises(ValidationError, match="leave it out"):
        world_of(HUT, boundary=[(0, 0), (1, 0), (1, 1)])
