"""The distance field: ranges compared with exact rays, derivatives with finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.geometry import se2
from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from common.geometry.world import World, load_world
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from services.estimator.precise.field import DistanceField, FieldModel
from services.estimator.precise.learning import weights
from services.estimator.shared.generative_models import RayCaster
from services.estimator.shared.model_folder import SHIPPED

ANGLES = np.deg2rad(np.linspace(-135, 135, 61))
BOX = World(name="box", boundary=[(0, 0), (6, 0), (6, 4), (0, 4)])


def analytic(resolution: float = 0.05) -> DistanceField:
    """The exact distance to the walls of an empty 6 m x 4 m room, negative outside, and a disc of 0.4 m in it."""
    x, y = np.meshgrid(np.arange(-0.5, 6.5, resolution), np.arange(-0.5, 4.5, resolution))
    walls = np.minimum(np.minimum(x, 6 - x), np.minimum(y, 4 - y))
    disc = np.hypot(x - 4.5, y - 3) - 0.4
    return DistanceField(np.minimum(walls, disc).astype(np.float32), (-0.5, -0.5), resolution)


def world_with(obstacle):
    return World(name="obstacle", boundary=BOX.boundary, obstacles=[obstacle])


ANALYTIC_WORLD = world_with({"circle": {"center": (4.5, 3), "radius": 0.4}})
BOX_THERE = {"center": (4.5, 3), "size": (0.8, 0.6)}


def poses_in(world: World, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([world.sample_free(count, rng, 0.1), rng.uniform(-np.pi, np.pi, count)])


def test_errors_and_beam_classes():
    poses = poses_in(ANALYTIC_WORLD, 100, 1)
    found = analytic().trace(poses, ANGLES)
    error = np.abs(found.ranges - ANALYTIC_WORLD.ray_distances(poses, ANGLES))
    # A curve of 0.4 m between nodes 0.05 m apart bulges by 0.05² / (8 * 0.4) = 0.8 mm.
    assert np.quantile(error, 0.98) < 2e-3
    unsure = (found.clearance < 0.03) | (found.depth_ratio < 0.75) | (found.cos_incidence < 0.3)
    assert error[~unsure].max() < 5e-3
    assert error[unsure].max() > 0.1  # large errors occur only in these classes


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_derivatives(seed):
    pose, model, step = poses_in(ANALYTIC_WORLD, 1, seed)[0], FieldModel(analytic(0.02)), 2e-4
    found = model.expect(pose[None], ANGLES).jacobian[0]
    ahead, behind = (model.expect(pose + side * step * np.eye(3), ANGLES).ranges for side in (1, -1))
    numeric = (ahead - behind).T / (2 * step)
    # A beam that jumps between surfaces, or grazes one, has no derivative to compare with.
    smooth = (np.abs(numeric).max(axis=1) < 8) & (np.abs(found).max(axis=1) < 8)
    error = np.abs(found - numeric)[smooth] / (1 + np.abs(numeric[smooth]))
    assert smooth.mean() > 0.4
    assert np.quantile(error, 0.9) < 0.05


@pytest.mark.parametrize("name", ["corridor", "maze", "office", "twins"])
def test_shipped_fields_show_no_surface_where_there_is_none(name):
    world, scanner = load_world(name), SCANNERS["tim571"]
    field = weights.load(weights.find(SHIPPED, world, name))[0].field
    lasers = se2.compose(world.sample_poses(500, np.random.default_rng(0), Robot().radius), np.array(scanner.mount))
    true = world.ray_distances(lasers, scanner.angles())
    too_near = field.trace(lasers, scanner.angles()).ranges < true - 0.05
    assert too_near.mean() < 5e-4  # beams that pass a corner closely


def test_no_surface():
    open_field = DistanceField(np.full((20, 20), 1.0, np.float32), (0.0, 0.0), 0.1)
    found = open_field.trace(np.array([[1.0, 1.0, 0.0], [9.0, 9.0, 0.0]]), ANGLES)
    assert np.isinf(found.ranges).all()
    assert not found.jacobian.any()


@pytest.mark.parametrize(
    "model",
    [FieldModel(analytic(0.02)), RayCaster(ANALYTIC_WORLD), RayCaster(world_with({"box": BOX_THERE}))],
    ids=["field", "circle", "box"],
)
def test_inside_a_surface(model):
    """A laser cannot be there, so the object was removed: its beams leave it and meet the walls."""
    inside, expected = np.array([[4.4, 2.9, 0.3]]), RayCaster(BOX)
    found = model.expect(inside, ANGLES)
    assert found.ranges == pytest.approx(expected.expect(inside, ANGLES).ranges, abs=2e-3)
    assert np.quantile(np.abs(found.jacobian - expected.expect(inside, ANGLES).jacobian), 0.98) < 0.02
    assert np.isinf(model.expect_behind(inside, ANGLES, found.ranges)).all()


@pytest.mark.parametrize("model", [FieldModel(analytic(0.02)), RayCaster(ANALYTIC_WORLD)], ids=["field", "exact"])
def test_surface_behind(model):
    """Behind the disc is the wall; behind the wall is nothing, nor behind a beam without return."""
    laser, angles = np.array([[1.0, 3.0, 0.0]]), np.array([0.0, 0.05, 2.0, -1.0])
    ranges = model.expect(laser, angles).ranges
    ranges[0, 3] = np.inf
    behind = model.expect_behind(laser, angles, ranges)
    walls = BOX.ray_distances(laser, angles)[0]
    assert (ranges[0, :2] < walls[:2] - 0.5).all()
    assert behind[0, :2] == pytest.approx(walls[:2], abs=2e-3)
    assert np.isinf(behind[0, 2:]).all()


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_nothing_is_known_behind_the_unknown_cells_of_a_map(yaw):
    """A door leads to a room of which the map shows only the far wall: its walls may be anywhere."""
    values = np.full((60, 200), UNKNOWN, np.uint8)
    values[5:55, 5:60] = FREE
    values[[4, 55], 4:61] = values[4:56, [4]] = OCCUPIED
    values[4:25, 60] = values[35:56, 60] = OCCUPIED  # with a door between, of 0.5 m
    values[:, 190] = OCCUPIED
    grid = OccupancyGrid.of(values, 0.05, (1.0, 2.0, yaw))
    laser = np.array([*grid.to_map(np.array([1.5, 1.5])), yaw])
    model = RayCaster(World(name="part", grid=grid))
    at_wall, through_door = (model.expect(laser[None], np.array([angle])) for angle in (np.pi, 0.0))
    assert at_wall.ranges[0, 0] == pytest.approx(1.25)
    assert np.isfinite(at_wall.scale[0, 0])
    assert 1.5 < through_door.ranges[0, 0] < 2.0
    assert np.isinf(through_door.scale[0, 0])
    assert not through_door.jacobian.any()
    known = RayCaster(
        World(name="all", grid=OccupancyGrid.of(np.where(values == UNKNOWN, FREE, values), 0.05, (0, 0, 0)))
    )
    assert known.expect(np.array([[1.5, 1.5, 0.0]]), np.zeros(1)).ranges[0, 0] == pytest.approx(8.0)
