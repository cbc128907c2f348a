"""Goals in a map that is still growing."""

from __future__ import annotations

import numpy as np

from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from common.messages.definitions import Map
from common.robot.robot import Robot
from services.controller.growing_map import PlanningMap
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.planner import GeodesicPolicy
from tests.controller.driving import PERIOD_NS, belief, scan
from tests.controller.driving import room as furnished

CELL = 0.05
NEAR, FAR = np.array([1.0, 1.0]), np.array([5.0, 1.0])


def half_known(x_known: float, *, poses=((1.0, 1.0, 0.0),), connected=()) -> Map:
    """A room of 6 m by 2 m, of which the part up to ``x_known`` m has been seen."""
    cells = np.full((44, 124), UNKNOWN, np.uint8)  # with a margin of 2 cells
    cells[2:42, 2:122] = FREE
    cells[:, [1, 122]] = cells[[1, 42]] = OCCUPIED
    cells[:, round(x_known / CELL) + 2 :] = UNKNOWN
    grid = OccupancyGrid.of(cells, CELL, (-0.1, -0.1, 0.0))
    return Map(stamp_ns=0, grid=grid, poses=np.array(poses), connected=np.array(connected, np.uint8))


def planner_in(message: Map) -> GeodesicPolicy:
    policy = GeodesicPolicy(Robot(), None)
    policy.use_map(PlanningMap.of(message, 0.27).graph, jumped=False)
    return policy


def test_free_space_of_a_growing_map():
    free = FreeSpace.of_map(half_known(3.0).grid)
    assert free.grid.resolution == 0.1
    assert 0.9 < free.clearance_at(NEAR) <= 1.0
    assert free.unknown is not None
    assert not free.unknown.ravel()[free.grid.cell_of(NEAR)]
    assert free.unknown.ravel()[free.grid.cell_of(FAR)]
    assert free.clearance_at(FAR) > 1.0  # what is unknown is no wall


def test_no_map_no_goal():
    policy = GeodesicPolicy(Robot(), None)
    assert "no map yet" in (policy.refusal(NEAR) or "")
    policy.use_map(PlanningMap.of(half_known(3.0), 0.27).graph, jumped=False)
    assert policy.refusal(NEAR) is None
    assert "the map so far is 0.10 m from a wall" in (policy.refusal(np.array([1.0, 0.1])) or "")
    assert "off the map" in (policy.refusal(np.array([9.0, 1.0])) or "")


def test_unknown_space_is_the_last_resort():
    """Of two ways around a wall, the longer one is known; without it, the way leads through the unknown."""
    cells = half_known(6.0).grid.values.copy()
    cells[2:24, 60:64] = OCCUPIED  # 1.1 m of wall from below
    cells[24:42, 60:64] = UNKNOWN
    message = half_known(6.0).model_copy(update={"grid": OccupancyGrid.of(cells, CELL, (-0.1, -0.1, 0.0))})
    field = planner_in(message).graph.cost_field(FAR)
    assert field is not None
    assert 4 < field.cost.ravel()[field.graph.grid.cell_of(NEAR)] < 20
    known = half_known(6.0).grid.values.copy()
    known[18:26, 60:64] = UNKNOWN  # there is a way above and below of it
    message = message.model_copy(update={"grid": OccupancyGrid.of(known, CELL, (-0.1, -0.1, 0.0))})
    field = planner_in(message).graph.cost_field(FAR)
    assert field is not None
    unknown = field.graph.free.unknown
    assert unknown is not None
    assert not unknown.ravel()[field.graph.grid.cell_of(field.path(NEAR))].any()


def test_a_new_map_renews_the_plan():
    policy = planner_in(half_known(6.0))
    policy.set_goal(FAR)
    pose, seen = np.array([*NEAR, 0.0]), furnished(6, 2)
    for stamp in (0, PERIOD_NS):
        policy.observe(scan(stamp, pose, seen), belief(stamp, pose))
        decision = policy.decide(belief(stamp, pose), np.zeros(3), np.zeros(3))
    assert len(decision.path)
    assert decision.action[0] > 0
    closed = half_known(6.0).grid.values.copy()
    closed[:, 60:64] = OCCUPIED
    message = half_known(6.0).model_copy(update={"grid": OccupancyGrid.of(closed, CELL, (-0.1, -0.1, 0.0))})
    policy.use_map(PlanningMap.of(message, 0.27).graph, jumped=False)
    policy.observe(scan(2 * PERIOD_NS, pose, seen), belief(2 * PERIOD_NS, pose))
    decision = policy.decide(belief(2 * PERIOD_NS, pose), np.zeros(3), np.zeros(3))
    assert decision.refused
    assert "cannot be reached" in decision.reason


def test_obstacles_move_to_a_new_map_unless_it_jumped():
    policy = planner_in(half_known(6.0))
    pose, changed = (
        np.array([*NEAR, 0.0]),
        furnished(6, 2, {"name": "box", "box": {"center": (3, 1), "size": (0.3, 0.3)}}),
    )
    policy.observe(scan(0, pose, changed), belief(0, pose))
    before = policy.obstacles.points()
    assert len(before)
    larger = half_known(6.0).grid
    cells = np.pad(larger.values, 10, constant_values=UNKNOWN)
    message = half_known(6.0).model_copy(update={"grid": OccupancyGrid.of(cells, CELL, (-0.6, -0.6, 0.0))})
    graph = PlanningMap.of(message, 0.27).graph
    policy.use_map(graph, jumped=False)
    np.testing.assert_allclose(policy.obstacles.points(), before, atol=1e-9)
    policy.use_map(graph, jumped=True)
    assert not len(policy.obstacles.points())


def test_a_loop_closure_is_a_jump():
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    before = PlanningMap.of(half_known(6.0, poses=poses[:2]), 0.27)
    after = [
        PlanningMap.of(half_known(6.0, poses=each), 0.27)
        for each in (poses, poses + np.array([0.0, 0.1, 0.0]), poses[:1])
    ]
    assert [each.jumped_from(before) for each in after] == [False, True, True]


def test_another_piece_as_the_map_is_a_jump():
    """Key scans are compared by their numbers, which leave out those of other pieces."""
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    before = PlanningMap.of(half_known(6.0, poses=poses[:2], connected=[1, 0, 1]), 0.27)
    for connected, jumped in (([1, 0, 1, 1], False), ([0, 1, 1, 1], True), ([1, 1, 0, 1], True), ([1, 1, 1], True)):
        assert PlanningMap.of(half_known(6.0, poses=poses, connected=connected), 0.27).jumped_from(before) is jumped


def test_anchored_poses_move_with_the_map():
    first, turned = [[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]], [[0.0, 0.0, 0.0], [2.0, 1.5, np.pi / 2], [4.0, 1.0, 0.0]]
    anchored = PlanningMap.of(half_known(6.0, poses=first, connected=[1, 0, 1]), 0.27).anchor(np.array([3.0, 1.0, 0.5]))
    moved = PlanningMap.of(half_known(6.0, poses=turned, connected=[1, 0, 1, 1]), 0.27)
    np.testing.assert_allclose(moved.locate([anchored]), [[2.0, 2.5, 0.5 + np.pi / 2]])
    other = PlanningMap.of(half_known(6.0, poses=turned, connected=[0, 1, 0, 1, 1]), 0.27)
    assert other.locate([anchored]).shape == (0, 3)
