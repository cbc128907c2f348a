"""Hypotheses between which a robot decides by driving."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.messages.definitions import BeliefHypothesis, Pose
from common.robot.robot import Robot
from common.robot.scan_geometry import Sector
from services.controller.policies.active_localisation import (
    CHOICE_PERIOD_NS,
    INITIAL_WAIT_NS,
    ActiveLocaliser,
    StallTimer,
    UnseenPoints,
)
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.geodesic_field import FreeSpaceGraph
from services.controller.policies.recovery import Recovery
from tests.controller.driving import SCANNER, belief, box, room, scan

ROBOT = Robot()


@pytest.mark.parametrize(("weight", "counted"), [(0.3, 0.3), (0.01, 0.05), (1e-4, None)])
def test_weight_of_the_second_hypothesis(weight, counted):
    """An improbable one counts as 5 %, one that would not keep the belief from being tracked not at all."""
    poses = np.array([[3.0, 2.0, 0.0], [7.0, 2.0, 0.0]])
    hypotheses = [BeliefHypothesis(pose=Pose.of(p), weight=w) for p, w in zip(poses, (1 - weight, weight), strict=True)]
    ambiguous = belief(0, poses[0], "ambiguous").model_copy(update={"hypotheses": hypotheses})
    graph = FreeSpaceGraph(FreeSpace.of(room(10, 4)), ROBOT.radius)
    paths = ActiveLocaliser(ROBOT, graph, 0.33, Recovery()).prediction_request(ambiguous)
    if counted is None:
        assert paths is None
    else:
        assert paths.weights.tolist() == pytest.approx([1 - weight, counted])


def test_obstacle_that_leaves_the_field_of_view():
    """It is kept for 5 s where dead reckoning expects it, unless it should be in view again and is not."""
    seen, empty, turn = scan(0, [3.0, 2.0, 0.0], room(10, 4)), np.zeros((0, 2)), np.array([0.0, 0.0, -0.5])
    points, leg = UnseenPoints(), np.array([[-0.3, 0.5]])  # 121 degrees to the left; the scanner sees up to 135
    assert np.array_equal(points.update(0, np.zeros(3), leg, seen), leg)
    np.testing.assert_allclose(points.update(10**9, turn, empty, seen), se2.rotate(0.5, leg))
    np.testing.assert_allclose(points.update(4 * 10**9, np.array([0.1, 0.0, 0.0]), empty, seen)[0, 1], 0.295, atol=0.01)
    assert len(points.update(5 * 10**9, np.zeros(3), empty, seen)) == 0
    points.update(6 * 10**9, np.zeros(3), leg, seen)
    assert len(points.update(7 * 10**9, turn, empty, seen)) == 1
    assert len(points.update(8 * 10**9, -turn, empty, seen)) == 0


def test_latest_of_unseen_points():
    """Of several points in a cell, the latest is kept."""
    seen, points = scan(0, [3.0, 2.0, 0.0], room(10, 4)), UnseenPoints()
    points.update(0, np.zeros(3), np.array([[-0.50, 0.51]]), seen)
    points.update(4 * 10**9, np.zeros(3), np.array([[-0.51, 0.505]]), seen)
    points.update(4 * 10**9 + 1, np.array([0.0, 0.0, -0.5]), np.zeros((0, 2)), seen)
    assert len(points.update(6 * 10**9, np.zeros(3), np.zeros((0, 2)), seen)) == 1


def test_time_for_progress():
    """It counts from when the robot may drive: not while it waits or backs off. A turn by half a radian is progress."""
    timer = StallTimer()
    assert not timer.expired
    timer.add_motion(0, np.zeros(3))
    timer.add_motion(4_000_000_000, np.zeros(3))
    assert timer.expired
    timer.restart()
    assert not timer.expired
    timer.add_motion(6_000_000_000, np.array([0.0, 0.0, 0.6]))
    timer.add_motion(8_000_000_000, np.array([0.1, 0.0, 0.0]))
    assert not timer.expired
    timer.add_motion(9_500_000_000, np.array([0.1, 0.0, 0.0]))
    assert timer.expired
    timer.add_motion(9_600_000_000, np.array([0.1, 0.0, 0.0]))
    assert not timer.expired


def test_slow_robot_makes_progress():
    timer = StallTimer(max_speed=0.05)
    for k in range(100):
        timer.add_motion(k * 100_000_000, np.array([0.005, 0.0, 0.0]))
        assert not timer.expired


def test_the_present_viewpoint_costs_as_much_as_its_path():
    """It is 2 m away, behind a wall around which the path is much longer."""
    poses, world = np.array([[3.5, 1.0, 0.0], [8.0, 1.0, 0.0]]), room(10, 6, box(4.5, 2.0, 0.2, 4.0))
    hypotheses = [BeliefHypothesis(pose=Pose.of(pose), weight=0.5) for pose in poses]
    ambiguous = belief(0, poses[0], "ambiguous").model_copy(update={"hypotheses": hypotheses})
    graph = FreeSpaceGraph(FreeSpace.of(world), ROBOT.radius)
    localiser = ActiveLocaliser(ROBOT, graph, 0.33, Recovery())
    localiser._viewpoint = np.array([2.0, 0.0, 0.0]), {}
    paths = localiser.prediction_request(ambiguous)
    assert paths.displacements[0].tolist() == [2.0, 0.0, 0.0]
    assert paths.path_costs[0] > 6.0
    assert paths.path_costs[0] == graph.cost_field(poses[0, :2]).cost_from(np.array([5.5, 1.0]))


def test_places_where_scans_tell_little():
    """Every metre there costs a hundred, so that no place is within the usual cost."""
    poses = np.array([[3.0, 2.0, 0.0], [7.0, 2.0, 0.0]])
    hypotheses = [BeliefHypothesis(pose=Pose.of(pose), weight=0.5) for pose in poses]
    ambiguous = belief(0, poses[0], "ambiguous").model_copy(update={"hypotheses": hypotheses})
    graph = FreeSpaceGraph(FreeSpace.of(room(10, 4)), ROBOT.radius)
    graph.set_extra_cost_per_metre(np.full(graph.grid.shape, 100.0))
    paths = ActiveLocaliser(ROBOT, graph, 0.33, Recovery()).prediction_request(ambiguous)
    assert paths is not None
    assert len(paths.displacements) > 5


def test_without_predictions_the_robot_asks_again_and_says_why_it_stands():
    poses, world = np.array([[3.0, 2.0, 0.0], [7.0, 2.0, 0.0]]), room(10, 4)
    hypotheses = [BeliefHypothesis(pose=Pose.of(pose), weight=0.5) for pose in poses]
    localiser = ActiveLocaliser(ROBOT, FreeSpaceGraph(FreeSpace.of(world), ROBOT.radius), 0.33, Recovery())
    for stamp in (0, CHOICE_PERIOD_NS):
        ambiguous = belief(stamp, poses[0], "ambiguous").model_copy(update={"hypotheses": hypotheses})
        assert localiser.prediction_request(ambiguous) is not None
        localiser.fail_prediction("is the estimator running?")
        decision = localiser.decide(
            ambiguous, scan(stamp, poses[0], world), np.zeros((0, 2)), np.zeros(3), Sector(0.0, np.pi)
        )
        assert decision.state == "lost"
        assert decision.reason.startswith("2 places are possible; standing without predicted scans")
        assert decision.reason.endswith("is the estimator running?")


@pytest.mark.parametrize("probability", [None, 0.01, 0.99])
def test_a_robot_that_probably_knows_its_place_stays_in_the_mapped_part_of_a_building(probability):
    """The map ends 2 m in front of it, where the hall goes on for 12 m; behind it are 5 m that the map shows."""
    pose, hall = np.array([8.0, 2.0, 0.0]), room(20, 4)
    graph = FreeSpaceGraph(FreeSpace.of(room(10, 4)), ROBOT.radius)
    localiser = ActiveLocaliser(ROBOT, graph, 0.33, Recovery(), may_turn=False)
    all_round = SCANNER.model_copy(update={"fov": 6.2})
    for stamp in (0, INITIAL_WAIT_NS):
        uncertain = belief(stamp, pose, "localising").model_copy(update={"probability": probability})
        seen = scan(stamp, pose, hall, all_round)
        decision = localiser.decide(uncertain, seen, np.zeros((0, 2)), np.zeros(3), Sector(0.0, np.pi))
    assert decision.state == "exploring"
    assert decision.action[0] < 0 if probability == 0.99 else decision.action[0] > 0


def test_a_hypothesis_from_which_the_map_has_no_path():
    """It is 1 m outside the mapped room. The robot does not stand for ever."""
    poses, hall = np.array([[11.0, 2.0, 0.0], [7.0, 2.0, 0.0]]), room(20, 4)
    hypotheses = [BeliefHypothesis(pose=Pose.of(pose), weight=0.5) for pose in poses]
    localiser = ActiveLocaliser(ROBOT, FreeSpaceGraph(FreeSpace.of(room(10, 4)), ROBOT.radius), 0.33, Recovery())
    ambiguous = belief(0, poses[0], "ambiguous").model_copy(update={"hypotheses": hypotheses})
    assert localiser.prediction_request(ambiguous) is None
    decision = localiser.decide(ambiguous, scan(0, poses[0], hall), np.zeros((0, 2)), np.zeros(3), Sector(0.0, np.pi))
    assert decision.state == "exploring"
    assert decision.action.any()
