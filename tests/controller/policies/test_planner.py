"""Driving in the simulator with the true pose as belief: around walls and unmapped obstacles, without contact."""

from __future__ import annotations

import re

import numpy as np
import pytest

from common.geometry.occupancy_grid import FREE, UNKNOWN, OccupancyGrid
from common.geometry.world import Obstacle, World
from common.messages.definitions import BeliefHypothesis, Pose
from common.messages.requests import PredictReply
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from services.controller.policies.expected_free_energy import NATS_PER_METRE
from services.controller.policies.motion_selection import Surroundings, select_motion
from services.controller.policies.planner import GeodesicPolicy
from services.controller.policies.straight_line import StraightLinePolicy
from tests.common.geometry.maps import rooms
from tests.controller.driving import KINDS, SCANNER, belief, box, drive, goal, path_length, room, scan, shipped

HALL = room(10, 5)
WALLS = box(5, 1, 0.2, 2, "left"), box(5, 4.1, 0.2, 1.8, "right")
OPEN_DOOR, SHUT_DOOR = room(10, 5, *WALLS), room(10, 5, *WALLS, box(5, 2.6, 0.1, 1.3, "door"))
TWO_ROOMS = room(10, 5, box(5, 2.5, 0.2, 5))


@pytest.mark.parametrize(("name", "kind"), [("maze", "holonomic"), ("office", "differential")])
def test_drives_around_walls(name, kind):
    world, robot, rng = shipped(name), Robot(drive=kind), np.random.default_rng(3)
    graph = GeodesicPolicy(robot, world).graph
    start, end = world.sample_free(2, rng, 0.32)
    shortest = path_length(graph.cost_field(end).path(start))
    poses, statuses, contacts = drive(world, robot, (*start, rng.uniform(-3, 3)), goal(*end))
    assert statuses[-1].state == "reached", (start, end, statuses[-1])
    assert contacts == 0
    assert np.hypot(*(poses[-1][:2] - end)) <= 0.02
    assert path_length(poses) <= 1.1 * shortest + 0.2


@pytest.mark.parametrize("kind", KINDS)
def test_turns_to_the_heading_of_the_goal(kind):
    to = goal(5.0, 1.5, yaw=2.0, yaw_tolerance=0.1)
    poses, statuses, _ = drive(HALL, Robot(drive=kind), (4.0, 1.5, 0.0), to)
    assert statuses[-1].state == "reached"
    assert abs(poses[-1][2] - 2.0) <= 0.1
    turning = [status.state for status in statuses if "turning to" in status.reason]
    assert set(turning) == {"navigating"}  # the goal is not reached before the turn ends


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("goal_y", "changed", "reason"),
    [
        (
            2.5,
            room(10, 5, box(7.5, 3.0, 0.6, 0.6)),
            r"0\.\d\d m from the goal, waiting; the nearest obstacle is something that is not in the map",
        ),
        (0.29, HALL, r"goal refused: .* cannot be reached exactly: stopped 0\.\d\d m from the goal"),
    ],
)
def test_stops_short_of_the_goal(kind, goal_y, changed, reason):
    """The box stands 0.2 m from the goal; the wall is 0.02 m from the footprint at the goal."""
    start, to = (7.5, 1.5, -1.5), goal(7.5, goal_y)
    poses, statuses, contacts = drive(changed, Robot(drive=kind), start, to, 160, known=HALL)
    assert (statuses[-1].state, contacts) == ("blocked", 0)
    assert re.match(reason, statuses[-1].reason)
    assert not any("backing off" in status.reason for status in statuses)
    assert np.ptp(poses[-60:, :2], axis=0).max() < 0.01


@pytest.mark.parametrize(("pause_s", "refused"), [(0.0, True), (4.0, False)])
def test_time_without_beliefs_is_not_time_without_progress(pause_s, refused):
    """A robot that stood near its goal because no beliefs came, as on a busy machine, is not stuck."""
    policy, pose = GeodesicPolicy(Robot(), HALL), np.array([7.5, 2.35, 1.5])
    policy.set_goal(np.array([7.5, 2.5]))
    stamps_s = np.arange(50) * 0.066 + np.where(np.arange(50) > 25, pause_s, 0.0)
    decisions = [policy.decide(belief(int(1e9 * stamp), pose), np.zeros(3), np.zeros(3)) for stamp in stamps_s]
    assert any(decision.refused for decision in decisions) == refused


@pytest.mark.parametrize("kind", KINDS)
def test_turning_around_is_not_being_stuck(kind):
    """A robot that turns slowly first has to turn to a goal behind it."""
    robot = Robot(drive=kind, max_turn=0.5)
    _, statuses, _ = drive(HALL, robot, (5.0, 2.5, 0.0), goal(4.8, 2.5), 300)
    assert statuses[-1].state == "reached"


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", KINDS)
def test_gap_between_boxes(kind, seed):
    """The path leads through gaps only if motions through them are allowed, with noise as well."""
    world = room(10, 6, box(5, 3.35, 0.46, 0.65, "a"), box(5.09, 1.98, 0.46, 0.65, "b"))
    scanner = SCANNERS["tim571"].with_beams(271)
    start, to = (2.03, 2.16, 0.86), goal(7.31, 3.15)
    _, statuses, contacts = drive(
        world, Robot(drive=kind), start, to, 240, known=room(10, 6), scanner=scanner, seed=seed
    )
    assert (statuses[-1].state, contacts) == ("reached", 0)


def test_corridor_that_tells_little_about_the_pose():
    """The ambiguity of the line ahead is summed exactly enough that the robot drives on."""
    robot = Robot(drive="differential", max_speed=1.5, acceleration=0.3)
    scanner = SCANNERS["tim571"].with_beams(135).model_copy(update={"range_max": 4.0})
    _, statuses, _ = drive(room(20, 4), robot, (1.5, 2.0, 0.0), goal(18.5, 2.0), 300, scanner=scanner)
    assert statuses[-1].state == "reached"


def test_driving_past_the_goal_is_not_being_stuck():
    """A robot that swings around its goal because its commands come late is not stopped by a wall."""
    policy, stamps_s, command = GeodesicPolicy(Robot(), HALL), np.arange(100) * 0.066, np.array([0.3, 0.0, 0.0])
    policy.set_goal(np.array([7.5, 2.5]))
    poses = [np.array([7.5 + 0.15 * np.cos(2 * stamp), 2.5 + 0.03, 1.5]) for stamp in stamps_s]
    beliefs = [belief(int(1e9 * stamp), pose) for stamp, pose in zip(stamps_s, poses, strict=True)]
    assert not any(policy.decide(each, command, np.zeros(3)).refused for each in beliefs)


@pytest.mark.parametrize("kind", KINDS)
def test_goal_beside_a_wall(kind):
    """The scanner's noise does not stop the robot before a goal 4 cm farther from a wall than its radius."""
    to = goal(7.5, Robot().radius + 0.04)
    poses, statuses, contacts = drive(HALL, Robot(drive=kind), (6.0, 1.5, -1.0), to, 240)
    assert (statuses[-1].state, contacts) == ("reached", 0)
    assert np.hypot(*(poses[-1][:2] - [7.5, 0.31])) < 0.02


@pytest.mark.parametrize(
    ("kind", "start"),
    [
        ("holonomic", (5.5, 2.5, 0.0)),
        ("holonomic", (9.0, 4.0, 2.0)),
        ("holonomic", (7.5, 1.0, 1.5)),
        ("differential", (9.0, 4.0, 2.0)),
    ],
)
def test_goal_that_was_occupied_for_a_while(kind, start):
    """The robot waits on its side of the goal until the box is taken away, and sees it go.

    It neither refuses the goal nor drives around the box, although the rear, which it does not see, may be free.
    """

    def change(simulation):
        if simulation.steps == 200:
            simulation.change_obstacle("remove", "box", None)

    changed = room(10, 5, box(7.5, 2.5, 0.3, 0.3))
    poses, statuses, contacts = drive(changed, Robot(drive=kind), start, goal(7.5, 2.5), 275, known=HALL, change=change)
    assert statuses[199].state == "blocked"
    assert path_length(poses[:200]) < np.hypot(*(np.array(start[:2]) - [7.5, 2.5]))
    assert not any(status.refused for status in statuses)
    assert (statuses[-1].state, contacts) == ("reached", 0)


def test_side_of_a_box_that_was_never_seen():
    """On a narrow curve around a box, its side comes out of the sector behind the robot that the scanner cannot see."""
    changed, start = room(10, 5, box(7.5, 2.5, 0.3, 0.3)), (8.584, 3.845, 1.4)
    assert drive(changed, Robot(drive="holonomic"), start, goal(7.5, 2.5), 120, known=HALL)[2] == 0


@pytest.mark.parametrize("kind", KINDS)
def test_no_faster_than_the_scanner_sees(kind):
    """A robot that needs 4 m to stop drives slowly enough to stop before a box that it sees from 3 m."""
    robot = Robot(drive=kind, max_speed=1.5, acceleration=0.3)
    scanner = SCANNER.model_copy(update={"range_max": 3.0})
    world = room(20, 4, box(12, 2, 0.4, 3.2))
    more = {"known": room(20, 4), "scanner": scanner, "stop": False}
    assert drive(world, robot, (1.5, 2.0, 0.0), goal(18.5, 2.0), 350, **more)[2] == 0


def test_published_energy():
    """The risk includes the path beyond the lookahead point; the probability is that among all motions compared."""
    policy, risks = GeodesicPolicy(Robot(), room(30, 5)), []
    for x in (5.0, 10.0, 20.0):
        policy.set_goal(np.array([25.0, 2.5]))
        decision = policy.decide(belief(0, [x, 2.5, 0.0]), np.array([0.5, 0.0, 0.0]), np.zeros(3))
        risks.append(decision.terms["risk"])
        assert 0 < decision.terms["probability"] < 0.2  # several motions are nearly as good
    np.testing.assert_allclose(-np.diff(risks), 2 * NATS_PER_METRE * np.array([5.0, 10.0]), rtol=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_probability_of_the_only_motion(kind):
    """Copies of a motion do not count as other motions."""
    angle = np.arange(0, 2 * np.pi, 0.05)
    ring = 0.331 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    around = Surroundings(lambda p: np.full(p.shape[:-1], np.inf), ring, np.zeros(len(ring), bool), 0.0, 0.33)
    selected = select_motion(np.zeros(3), np.array([2.0, 0.0]), around, Robot(drive=kind))
    assert not selected.action[:2].any()
    assert selected.terms["probability"] > (0.9 if kind == "holonomic" else 0.05)  # a differential base may turn


@pytest.mark.parametrize("kind", KINDS)
def test_drives_around_an_unmapped_box(kind):
    changed = room(10, 5, box(5, 2.5, 0.6, 1.2))
    poses, statuses, contacts = drive(changed, Robot(drive=kind), (2.5, 2.5, 0.0), goal(7.5, 2.5), known=HALL)
    assert (statuses[-1].state, contacts) == ("reached", 0)
    assert np.abs(poses[:, 1] - 2.5).max() > 0.8
    assert path_length(poses) < 7.0


def test_new_box():
    hall, world = room(10, 3), room(10, 3, box(9.5, 1.5, 0.6, 1.2))

    def change(simulation):
        if simulation.steps == 30:
            simulation.change_obstacle("move", "box", Obstacle(box={"center": (3.9, 1.5), "size": (0.6, 1.2)}))

    _, statuses, _ = drive(world, Robot(), (1.5, 1.5, 0.0), goal(8.5, 1.5), 60, known=hall, change=change)
    reasons = [status.reason.split(",")[0] for status in statuses[30:]]
    assert set(reasons[:15]) == {"waiting; the nearest obstacle is something that may move"}
    assert not any("may move" in reason for reason in reasons[15:])


@pytest.mark.parametrize("kind", KINDS)
def test_closed_door(kind):
    def change(simulation):
        if simulation.steps == 180:
            simulation.change_obstacle("remove", "door", None)

    start, to = (3.5, 2.5, 0.0), goal(6.5, 2.5)
    poses, statuses, contacts = drive(SHUT_DOOR, Robot(drive=kind), start, to, known=OPEN_DOOR, change=change)
    assert (statuses[-1].state, contacts) == ("reached", 0)
    assert (poses[:180, 0] < 5).all()
    waiting = statuses[60:180]  # until then it is on the way to the door
    assert any("no way" in status.reason for status in waiting if status.state == "blocked")
    assert {status.state for status in waiting if status.reason == "stuck: backing off"} == {"blocked"}
    # Between two recoveries the robot returns to the door.
    assert sum(status.state == "blocked" for status in waiting) > 0.3 * len(waiting)


def test_nearest_reachable_place():
    policy = GeodesicPolicy(Robot(), TWO_ROOMS)
    nearest = "; the nearest place that can be reached is ("
    assert f"(5.00, 2.50) in room is inside something, or off the map{nearest}" in policy.refusal(np.array([5.0, 2.5]))
    assert f"is 0.20 m from a wall, and the robot needs 0.27 m around it{nearest}0.35, 2." in policy.refusal(
        np.array([0.2, 2.5])
    )
    # In the other room: refused as soon as it is known in which room the robot is.
    other = np.array([8.0, 2.5])
    assert policy.refusal(other) is None
    policy.set_goal(other)
    pose = np.array([2.0, 2.5, 0.0])
    policy.observe(scan(0, pose, TWO_ROOMS), belief(0, pose))
    decision = policy.decide(belief(0, pose), np.zeros(3), np.zeros(3))
    assert (decision.refused, decision.action.any()) == (True, False)
    assert f"cannot be reached from here{nearest}4.5" in decision.reason


def test_goals_off_the_map():
    world = World(name="rooms", grid=OccupancyGrid.of(rooms(200), 0.05, (-10.0, -10.0, 0.0)))
    row, column = np.argwhere(world.grid.values == UNKNOWN)[0]
    unknown = world.grid.geometry.points_in_cells(np.array([[column, row]]), 0.5)[0]
    policies = GeodesicPolicy(Robot(), world), StraightLinePolicy(Robot(), None, world)
    for place in (unknown, np.array([50.0, 50.0])):
        assert all("is inside something, or off the map" in policy.refusal(place) for policy in policies)


def test_map_of_one_cell():
    world = World(name="dot", grid=OccupancyGrid.of(np.array([[FREE]], np.uint8), 0.05, (0.0, 0.0, 0.0)))
    policy = GeodesicPolicy(Robot(), world)
    assert policy.refusal(np.array([0.02, 0.02])) is not None
    assert policy.graph.cost_field(np.array([0.02, 0.02])) is None


@pytest.mark.parametrize("kind", KINDS)
def test_empty_map_without_obstacle_stop(kind):
    """Every wall within the boundary is unmapped."""
    world, rng = shipped("maze"), np.random.default_rng(5)
    empty = World(name="empty", boundary=world.boundary)
    start, end = world.sample_free(2, rng, 0.45)
    start = (*start, rng.uniform(-np.pi, np.pi))
    poses, _, contacts = drive(world, Robot(drive=kind), start, goal(*end), 120, known=empty, stop=False)
    assert contacts == 0, (start, end)
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() * 15 > 0.9  # m/s, so braking was necessary


@pytest.mark.parametrize(("epistemic", "low", "high"), [(True, 0.0, 0.1), (False, 0.4, 1.0)])
def test_route_in_a_wide_hall(epistemic, low, high):
    """Share of the route on which a scanner with 4 m of range sees no wall (coastal navigation)."""
    hall = room(24, 16)
    policy = GeodesicPolicy(Robot(), hall, epistemic=epistemic)
    policy.prepare(scan(0, [2.0, 2.0, 0.0], hall, SCANNER.model_copy(update={"range_max": 4.0})))
    route = policy.graph.cost_field(np.array([22.0, 14.0])).path(np.array([2.0, 2.0]))
    assert low <= np.mean(policy.free.clearance_at(route) > 4.0) <= high


def test_backing_off():
    """As in a doorway that is free for the planner but not for the limits: the velocity stays zero."""
    policy, pose = GeodesicPolicy(Robot(), HALL), np.array([5.0, 1.5, 0.0])
    policy.set_goal(np.array([9.0, 1.5]))
    reasons = [policy.decide(belief(k * 66_000_000, pose), np.zeros(3), np.zeros(3)).reason for k in range(60)]
    assert (reasons[0], reasons[-1]) == ("", "stuck: backing off")


@pytest.mark.parametrize("state", ["ambiguous", "lost"])
def test_backing_off_while_not_localised(state):
    policy, pose = GeodesicPolicy(Robot(), HALL), np.array([5.0, 1.5, 0.0])
    policy.set_goal(np.array([9.0, 1.5]))
    hypotheses = [BeliefHypothesis(pose=Pose(x=x, y=1.5), weight=0.5) for x in (5, 7)]
    for number in range(75):
        unsure = belief(number * 66_000_000, pose, state).model_copy(update={"hypotheses": hypotheses})
        policy.observe(scan(unsure.stamp_ns, pose, HALL), unsure)
        if (motions := policy.prediction_request(unsure)) is not None:
            ranges = np.ones(motions.poses()[..., 0].size, np.float32)
            policy.use_predictions(PredictReply(angles=np.zeros(1, np.float32), ranges=ranges))
        # It turns to and fro a little, because of noise in the scans, and gets nowhere.
        decision = policy.decide_unlocalised(unsure, np.array([0.0, 0.0, 0.2 * (-1) ** number]), np.zeros(3))
    assert (decision.reason, decision.recovering) == ("stuck: backing off", True)


def test_place_that_was_reached():
    """It is no longer a candidate: the robot would stay there for as long as no other place is worth its path."""
    policy, pose = GeodesicPolicy(Robot(), HALL), np.array([5.0, 1.5, 0.0])
    policy.set_goal(np.array([9.0, 1.5]))
    hypotheses = [BeliefHypothesis(pose=Pose(x=x, y=1.5), weight=0.5) for x in (5, 7)]
    unsure = belief(0, pose, "ambiguous").model_copy(update={"hypotheses": hypotheses})
    policy.observe(scan(0, pose, HALL), unsure)
    motions = policy.prediction_request(unsure)
    policy.use_predictions(PredictReply(ranges=np.ones(motions.poses()[..., 0].size, np.float32)))

    def candidates(seconds, velocity):
        now = unsure.model_copy(update={"stamp_ns": round(seconds * 1e9)})
        policy.decide_unlocalised(now, velocity, np.zeros(3))
        return policy.prediction_request(now).displacements

    place = candidates(1, np.zeros(3))[0]
    on_the_way = candidates(2, np.array([*place[:2], 0.0]) / 2)
    assert on_the_way[0] == pytest.approx([*place[:2] / 2, place[2]])
    assert np.hypot(*candidates(3, np.array([*place[:2], 0.0]) / 2)[:, :2].T).min() > 0.25


@pytest.mark.parametrize("kind", KINDS)
def test_drives_slowly_while_not_localised(kind):
    start = (6.0, 4.0, 0.0)
    poses, statuses, _ = drive(shipped("office"), Robot(drive=kind), start, goal(15.0, 4.0), 60, state="localising")
    assert statuses[-1].state == "exploring"
    assert 0.2 < np.hypot(*np.diff(poses[:, :2], axis=0).T).max() * 15 <= 0.5 + 0.02
