"""Exact rays: values computed by hand, brute force with shapely, derivatives by finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.outline_index import OutlineIndex
from common.geometry.ray_casting import cast_rays, cast_rays_with_jacobian, clear_radius
from common.geometry.world import World
from tests.common.geometry.maps import HUT, ROOM, rooms, speckled

ANGLES = np.linspace(-3, 3, 13)
CRATE = {"circle": {"center": (4.0, 5.0), "radius": 0.3}}


def on_grid(values, resolution=0.5, origin=(1.0, -2.0, 0.7), obstacles=(CRATE,)):
    return World(name="x", grid=OccupancyGrid.of(values, resolution, origin), obstacles=list(obstacles))


PLAIN_HUT = on_grid(HUT, origin=(0, 0, 0), obstacles=())


def brute_force(world, pose, angle):
    start, along = pose[:2], np.array([np.cos(pose[2] + angle), np.sin(pose[2] + angle)])
    ray = shapely.LineString([start, start + 200 * along])
    edges = shapely.MultiLineString(list(world.segments.reshape(-1, 2, 2)))
    found = [np.hypot(*(hit - start)) for hit in shapely.get_coordinates(shapely.intersection(ray, edges))]
    for *centre, radius in world.circles:
        away = np.array(centre) - start
        roots = np.roots([1, -2 * along @ away, away @ away - radius**2])
        found += [roots.min()] if np.isrealobj(roots) and roots.min() >= 0 else []
    return min(found, default=np.inf)


@pytest.mark.parametrize(
    ("world", "pose", "ranges"),  # ahead, left, back, right
    [
        (ROOM, [5.0, 4.0, 0.0], [3.0, 1.0, 2 - np.sqrt(0.6**2 - 0.5**2), 4.0]),  # the circle behind
        (ROOM, [0.5, 2.0, 0.0], [0.5, 4.0, 0.5, 2.0]),
        (ROOM, [20.0, 3.0, 0.0], [np.inf, np.inf, 12.0, np.inf]),
        (PLAIN_HUT, [2.75, 1.25, 0.0], [1.25, 1.75, 1.75, np.inf]),  # the door on the right
        (PLAIN_HUT, [0.25, 3.25, 0.0], [0.25, np.inf, np.inf, np.inf]),  # in an unknown cell
        (PLAIN_HUT, [-7.0, 3.25, 0.0], [7.5, np.inf, np.inf, np.inf]),  # off the map
    ],
)
def test_known_ranges(world, pose, ranges):
    assert cast_rays(world, pose, np.arange(4) * np.pi / 2)[0] == pytest.approx(ranges)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["room", "cells", "large cells"]))
def test_brute_force(seed, kind):
    rng = np.random.default_rng(seed)
    world = {"room": lambda: ROOM, "cells": lambda: on_grid(speckled(seed)), "large cells": lambda: on_grid(rooms(260))}
    world = world[kind]()
    poses = np.column_stack([rng.uniform(-4, 14, (4, 2)), rng.uniform(-np.pi, np.pi, 4)])
    expected = [[brute_force(world, pose, angle) for angle in ANGLES] for pose in poses]
    np.testing.assert_allclose(cast_rays(world, poses, ANGLES), expected, atol=1e-9, rtol=1e-9)


def clutter(seed):
    """A hall with boxes and circles, half of them on whole metres, and the same world with all outlines in one cell."""
    rng = np.random.default_rng(seed)
    width, height = rng.integers(3, 40, 2).tolist()
    obstacles = []
    for k in range(rng.integers(0, 60)):
        x, y = np.where(k % 2, rng.integers(0, [width, height]), rng.uniform(0, [width, height])).tolist()
        yaw, size = rng.choice([0.0, 45.0, rng.uniform(0, 90)]), rng.uniform(0.05, 3)
        box = {"box": {"center": (x, y), "size": (size, 1.0), "yaw_deg": yaw}}
        obstacles.append(box if k % 3 else {"circle": {"center": (x, y), "radius": size / 2}})
    world = World(name="x", boundary=[(0, 0), (width, 0), (width, height), (0, height)], obstacles=obstacles)
    listed = world.model_copy()
    count, far = len(world.outlines) + len(world.circles), 1e3
    one_cell = OutlineIndex(
        world.outlines, world.circles, np.array([0, count]), np.arange(count), (1, 1), (-far, -far, 2 * far)
    )
    listed.__dict__["outline_index"] = one_cell  # the cached property
    return world, listed


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
@example(17051)  # a ray ends in a corner
def test_outline_index(seed):
    world, listed = clutter(seed)
    x0, y0, x1, y1 = world.bounds
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform([x0 - 2, y0 - 2], [x1 + 2, y1 + 2], (12, 2)), np.zeros(12)])
    poses[:4] = np.round(poses[:4])  # with rays along the edges of cells, and along outlines
    angles = np.linspace(-np.pi, np.pi, 41)
    people = np.array([[*poses[5, :2], 0.3], [*poses[6, :2], 1.5]])
    for crowd in (None, people):
        np.testing.assert_array_equal(cast_rays(world, poses, angles, crowd), cast_rays(listed, poses, angles, crowd))
    jacobians = [cast_rays_with_jacobian(each, poses, angles)[1] for each in (world, listed)]
    np.testing.assert_allclose(*jacobians, atol=1e-9)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_derivatives(seed, gridded):
    world, rng, small = on_grid(speckled(seed, 20)) if gridded else ROOM, np.random.default_rng(seed), 1e-6
    poses = np.column_stack([rng.uniform(-1, 9, (40, 2)), rng.uniform(-np.pi, np.pi, 40)])
    ranges, jacobian = cast_rays_with_jacobian(world, poses, ANGLES)
    assert np.array_equal(ranges, cast_rays(world, poses, ANGLES))
    assert not jacobian[np.isinf(ranges)].any()
    for offset in small * np.eye(3):
        ahead, behind = (cast_rays(world, poses + step, ANGLES) for step in (offset, -offset))
        with np.errstate(invalid="ignore"):
            slope, bend = (ahead - behind) / (2 * small), np.abs(ahead + behind - 2 * ranges)
        # Without beams that jump to another surface, and grazing beams, whose derivative is limited.
        smooth = (bend < 1e-8) & (np.hypot(*jacobian[..., :2].T).T < 40)
        np.testing.assert_allclose(slope[smooth], (jacobian @ offset)[smooth] / small, atol=1e-2)
        assert smooth[np.isfinite(ranges)].mean() > 0.5


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.02, 0.5]))
def test_clear_squares_are_empty(seed, share):
    rng = np.random.default_rng(seed)
    occupied = rng.random((20, 30)) < share
    for (row, column), radius in np.ndenumerate(clear_radius(occupied).astype(int)):
        square = occupied[max(0, row - radius) : row + radius + 1, max(0, column - radius) : column + radius + 1]
        assert square.any() == occupied[row, column]


def test_no_poses():
    assert cast_rays(ROOM, np.zeros((0, 3)), ANGLES).shape == (0, len(ANGLES))
