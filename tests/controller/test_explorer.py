"""The course of an exploration: goals one after another, those of a user first, and the way back."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from common.messages.definitions import Drive, Map, Twist
from common.robot.robot import Robot
from services.controller.goal_state import Phase
from services.controller.growing_map import PlanningMap
from services.controller.navigator import Navigator
from services.controller.policies.exploration import NoPath, Viewpoint
from services.controller.policies.planner import GeodesicPolicy
from tests.controller.driving import PERIOD_NS, belief, goal, room, scan

HALL, START = room(10, 5), (2.0, 2.5, 0.0)
SCANS_PER_S = 15
GRID = OccupancyGrid.of(np.full((100, 200), FREE, np.uint8), 0.05, (0.0, 0.0, 0.0))


def map_with(*poses, connected=()) -> PlanningMap:
    """A map with these key scans; ``connected`` as in the message."""
    message = Map(stamp_ns=0, grid=GRID, poses=np.array(poses, float), connected=np.array(connected, np.uint8))
    return PlanningMap.of(message, 0.27)


class PerfectRobot:
    """A robot that moves as commanded and knows its pose; the test chooses its viewpoints."""

    def __init__(self, *, mapped: bool = True) -> None:
        self.policy = GeodesicPolicy(Robot(), None)
        self.navigator = Navigator(Robot(), chosen_policy=self.policy)
        self.pose, self.scans = np.array(START), 0
        if mapped:
            self.use_map(map_with(START))
        self.step()

    def use_map(self, planned: PlanningMap) -> None:
        self.policy.use_map(planned.graph, jumped=False)
        self.navigator.on_map(planned)

    def step(self, *, moves: bool = True, state: str = "tracking"):
        stamp = self.scans * PERIOD_NS
        self.scans += 1
        self.navigator.on_scan(scan(stamp, self.pose, HALL))
        command, status = self.navigator.step(belief(stamp, self.pose, state=state))
        if moves:
            self.pose = se2.compose(self.pose, command.twist.array() * PERIOD_NS * 1e-9)
        return status

    def until(self, condition, limit=600, *, moves: bool = True):
        for _ in range(limit):
            if condition(status := self.step(moves=moves)):
                return status
        raise AssertionError(status)

    def explore(self, *places) -> None:
        """Gives the robot viewpoints at these places in m, one after another.

        None ends the exploration; a `NoPath` is the reason why no viewpoint can be planned.
        """
        for place in places:
            viewpoint = place
            if isinstance(place, tuple):
                viewpoint = Viewpoint(np.array([*place, 0.0]), 9.0, np.array([place]))
            exploration_state = self.navigator.take_exploration_state()
            assert exploration_state is not None
            self.navigator.use_viewpoint(viewpoint, exploration_state)


def exploring_robot() -> PerfectRobot:
    robot = PerfectRobot()
    robot.navigator.on_goal(goal(0, 0, explore=True, seq=5))
    return robot


def test_no_exploration_in_a_known_world():
    navigator = Navigator(Robot(), world=HALL, chosen_policy=GeodesicPolicy(Robot(), HALL))
    navigator.on_goal(goal(0, 0, explore=True, seq=5))
    status = navigator.goal_state.status(0, None)
    assert status.refused
    assert "in a known world: start with `presage up --mapping`" in status.reason


@pytest.mark.parametrize("world", [HALL, None])
def test_no_exploration_with_preset_paper(world):
    navigator = Navigator(Robot(), world=world)
    navigator.on_goal(goal(0, 0, explore=True, seq=5))
    status = navigator.goal_state.status(0, None)
    assert status.refused
    assert "preset paper cannot explore: use preset geodesic" in status.reason


def test_exploration_waits_for_the_first_map():
    robot = PerfectRobot(mapped=False)
    robot.navigator.on_goal(goal(0, 0, explore=True, seq=5))
    status = robot.step()
    assert (status.state, status.exploration.seq, status.reason) == (
        "exploring",
        5,
        "waiting for the mapper's first map",
    )
    assert robot.navigator.take_exploration_state() is None
    robot.use_map(map_with(START))
    robot.step()
    robot.explore((5.0, 2.5))
    assert robot.step().goal.x == 5
    robot.navigator.on_goal(goal(0, 0, cancel=True))
    assert robot.step().exploration is None


def test_a_map_without_key_scans_is_no_map_to_explore():
    robot = PerfectRobot(mapped=False)
    robot.navigator.on_goal(goal(0, 0, explore=True, seq=5))
    empty = PlanningMap.of(Map(stamp_ns=0, grid=GRID, poses=np.zeros((0, 3))), 0.27)
    robot.use_map(empty)
    assert robot.step().reason == "waiting for the mapper's first map"
    robot.use_map(map_with(START))
    robot.step()
    robot.explore((3.0, 2.5))
    robot.use_map(empty)
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    assert len(robot.navigator.take_exploration_state().arrivals) == 1


def test_kidnapped():
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.pose[0] > 3.0)
    driven = robot.step().exploration.path
    robot.pose = np.array([4.0, 1.0, 0.0])
    statuses = [robot.step(state="lost") for _ in range(10 * SCANS_PER_S)]  # longer than at a place without progress
    assert all(status.reason.startswith("the belief is lost") for status in statuses)
    robot.use_map(map_with(START))
    assert robot.navigator.take_exploration_state() is None  # where it would begin is not known
    path, place = statuses[-1].exploration.path, robot.pose
    robot.pose = place - [3.0, 0.0, 0.0]
    status = robot.step()
    assert (status.goal.x, status.reason) == (8.0, "driving to a viewpoint")
    assert status.exploration.path == path > driven + 0.5
    assert len(robot.navigator.take_exploration_state().unreachable) == 0


@pytest.mark.parametrize("before_the_first", [True, False])
def test_kidnapped_without_a_viewpoint(before_the_first):
    """The robot drives until it is localised, and only then chooses a viewpoint."""
    robot = exploring_robot()
    if not before_the_first:
        robot.explore((3.0, 2.5))
        robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    place = robot.pose
    for _ in range(5 * SCANS_PER_S):
        status = robot.step(state="lost")
        assert (status.state, status.refused) == ("lost", False)
        assert robot.navigator.take_exploration_state() is None
    assert np.hypot(*(robot.pose - place)[:2]) > 0.2
    robot.step()
    robot.explore((5.0, 2.5))
    assert robot.step().goal.x == 5


def test_exploration_that_is_requested_after_a_kidnapping():
    """The robot first localises itself; it will return to where it was then, not to where it was last localised."""
    robot = PerfectRobot()
    robot.pose = np.array([6.0, 1.5, 0.0])
    robot.step(state="lost")
    robot.navigator.on_goal(goal(0, 0, explore=True, seq=5))
    for _ in range(5 * SCANS_PER_S):
        status = robot.step(state="lost")
    assert status.reason == "waiting until the robot is localised in the map"
    assert np.hypot(*(robot.pose[:2] - (6.0, 1.5))) > 0.2
    localised = robot.pose
    robot.step()
    robot.explore((5.0, 2.5))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    robot.explore(None)
    home = robot.until(lambda status: status.goal is not None).goal
    assert (home.x, home.y) == pytest.approx(localised[:2], abs=0.05)


def test_a_choice_waits_for_the_first_scan():
    navigator = Navigator(Robot(), chosen_policy=GeodesicPolicy(Robot(), None))
    navigator.on_map(map_with(START))
    navigator.on_goal(goal(0, 0, explore=True, seq=5))
    navigator.step(belief(0, START))
    assert navigator.take_exploration_state() is None
    navigator.on_scan(scan(PERIOD_NS, START, HALL))
    assert navigator.take_exploration_state() is not None


def test_a_choice_is_repeated_if_the_robot_was_kidnapped_meanwhile():
    robot = exploring_robot()
    exploration_state = robot.navigator.take_exploration_state()
    robot.step(state="lost")
    robot.navigator.use_viewpoint(NoPath("too little room"), exploration_state)
    robot.step()
    robot.explore((5.0, 2.5))
    assert robot.step().exploration.phase == "exploring"


def test_choices_from_before_a_new_goal_are_ignored():
    robot = exploring_robot()
    of_earlier = robot.navigator.take_exploration_state()
    robot.navigator.on_goal(goal(0, 0, explore=True, seq=6))
    robot.navigator.use_viewpoint(None, of_earlier)
    robot.step()
    before_pause = robot.navigator.take_exploration_state()
    robot.navigator.on_goal(goal(*START[:2], seq=7))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    robot.navigator.use_viewpoint(NoPath("too little room"), before_pause)
    assert robot.step().exploration.phase == "exploring"


def test_viewpoints_then_the_way_back():
    robot = exploring_robot()
    robot.explore((5.0, 2.5))
    status = robot.step()
    assert (status.state, status.goal.x, status.exploration.phase, status.exploration.seq) == (
        "exploring",
        5,
        "exploring",
        5,
    )
    assert np.isclose(status.exploration.area, 50.0)
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    assert np.hypot(*(robot.pose[:2] - [5.0, 2.5])) < 0.1
    robot.explore(None)
    assert robot.step().exploration.phase == "returning"
    status = robot.until(lambda status: status.exploration.phase == "finished")
    assert np.hypot(*(robot.pose - START)[:2]) < 0.01
    assert 5.9 < status.exploration.path < 7.5
    assert status.state == "reached"
    assert robot.navigator.take_exploration_state() is None


def test_returns_to_a_start_that_moved_by_centimetres():
    robot = exploring_robot()
    robot.explore((5.0, 2.5))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    robot.explore(None)
    robot.until(lambda _: robot.pose[0] < 4.0)
    robot.use_map(map_with((2.0, 2.58, 0.0)))
    robot.explore(None)
    robot.until(lambda status: status.exploration.phase == "finished")
    assert np.hypot(*(robot.pose[:2] - [2.0, 2.58])) < 0.01


def test_a_goal_of_a_user_takes_precedence():
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.pose[0] > 3.0)
    robot.navigator.on_goal(goal(3.0, 1.5, seq=6))
    robot.use_map(map_with(START, (3.0, 2.5, 0.0)))
    assert robot.navigator.take_exploration_state() is None  # no viewpoint is chosen meanwhile
    status = robot.until(lambda status: status.state == "reached")
    assert (status.goal_seq, status.exploration.phase) == (6, "exploring")
    count = robot.scans
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    assert robot.scans - count >= 2 * SCANS_PER_S - 1  # long enough to publish that the goal was reached
    robot.explore((8.0, 2.5))
    assert robot.step().state == "exploring"


def test_every_status_tells_the_progress():
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    statuses = [robot.step(), robot.navigator.status(0), robot.navigator.stop_without_belief(0, "no belief")[1]]
    robot.navigator.on_drive(Drive(stamp_ns=0, twist=Twist(vx=0.1)))
    statuses += [robot.step(), robot.navigator.step_without_belief(robot.scans * PERIOD_NS)[1]]
    assert [status.state for status in statuses] == ["exploring", "exploring", "lost", "manual", "manual"]
    assert {status.exploration.seq for status in statuses} == {5}


def test_cancelling_ends_it():
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.pose[0] > 3.0)
    robot.navigator.on_goal(goal(0, 0, cancel=True))
    status = robot.until(lambda _: not robot.navigator._command.velocity.any())
    assert (status.state, status.exploration) == ("idle", None)


def test_a_place_without_progress_is_given_up():
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due, moves=False)
    exploration_state = robot.navigator.take_exploration_state()
    assert exploration_state.unreachable.tolist() == [[8.0, 2.5]]
    assert not len(exploration_state.arrivals)


@pytest.mark.parametrize("manual", [True, False])
def test_no_place_is_given_up_for_the_time_without_updates(manual):
    """The robot is driven by hand, or there are no beliefs."""
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.step()
    if manual:
        for _ in range(10 * SCANS_PER_S):
            robot.navigator.on_drive(Drive(stamp_ns=0, twist=Twist(vx=0.1)))
            assert robot.step(moves=False).state == "manual"
    else:
        robot.scans += 10 * SCANS_PER_S
    for _ in range(SCANS_PER_S):
        robot.step()
    assert robot.navigator.explorer.goal.pose.x == 8.0


def test_a_way_back_that_stays_refused_fails():
    robot = exploring_robot()
    robot.explore((5.0, 2.5))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    shut = GRID.values.copy()
    shut[:, 70:76] = OCCUPIED
    grid = OccupancyGrid.of(shut, 0.05, (0.0, 0.0, 0.0))
    robot.use_map(PlanningMap.of(Map(stamp_ns=0, grid=grid, poses=np.array([START])), 0.27))
    robot.explore(None)
    count, status = robot.scans, robot.step()
    while status.exploration.phase == "returning":
        if robot.navigator.explorer.viewpoint_due:
            robot.explore(None)
        status = robot.step()
    assert status.exploration.phase == "failed"
    assert status.reason.startswith("cannot return to the start")
    assert "cannot be reached" in status.reason
    assert 7 * SCANS_PER_S < robot.scans - count < 10 * SCANS_PER_S


def test_no_room_at_the_start_fails():
    robot = exploring_robot()
    robot.explore(NoPath("too little room"))
    status = robot.step()
    assert (status.exploration.phase, status.state, status.refused) == ("failed", "blocked", True)
    assert status.reason == "too little room"
    assert robot.navigator.take_exploration_state() is None
    robot.navigator.on_goal(goal(0, 0, cancel=True))
    assert robot.step().state == "idle"


def test_the_robot_stops_when_the_exploration_fails():
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.pose[0] > 3.0)
    robot.use_map(map_with((3.0, 2.5, 0.0), connected=[0, 1]))  # without the start
    robot.explore(None)
    status = robot.until(lambda _: not robot.navigator._command.velocity.any())
    assert (status.exploration.phase, status.state, status.refused) == ("failed", "blocked", True)
    assert robot.pose[0] < 4.0


def test_after_the_way_back_there_may_be_more_room():
    robot = exploring_robot()
    robot.explore((5.0, 2.5))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    robot.explore(NoPath("too little room"))
    assert robot.step().exploration.phase == "returning"
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    assert np.hypot(*(robot.pose - START)[:2]) < 0.01
    robot.explore((3.0, 2.5))
    assert robot.step().exploration.phase == "exploring"
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    robot.explore(None)
    robot.until(lambda status: status.exploration.phase == "finished")


def test_a_new_map_may_show_a_better_viewpoint_and_moves_the_start():
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.step()
    robot.use_map(map_with((2.1, 2.5, 0.0), (3.0, 2.5, 0.0)))
    exploration_state = robot.navigator.take_exploration_state()
    assert exploration_state.target.tolist() == [8.0, 2.5]
    assert exploration_state.home.tolist() == [2.1, 2.5]
    robot.navigator.use_viewpoint(Viewpoint(np.array([4.0, 4.0, 0.0]), 9.0, np.zeros((1, 2))), exploration_state)
    assert robot.step().goal.y == 4.0


def test_another_piece_becomes_the_map():
    """The start has no place in it, until the pieces are joined."""
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.use_map(map_with((3.0, 2.5, 0.0), (4.0, 2.5, 0.0), connected=[0, 1, 1]))
    exploration_state = robot.navigator.take_exploration_state()
    assert exploration_state.home.tolist() == list(START[:2])  # where the robot is
    robot.navigator.use_viewpoint(None, exploration_state)
    status = robot.step()
    assert (status.exploration.phase, status.reason) == (
        "failed",
        "cannot return to the start: nothing connects it to the present map",
    )
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.use_map(map_with((3.0, 2.5, 0.0), (4.0, 2.5, 0.0), connected=[0, 1, 1]))
    robot.explore((7.0, 2.5))
    robot.use_map(map_with((1.5, 2.5, 0.0), (3.0, 2.5, 0.0), (4.0, 2.5, 0.0)))
    assert robot.navigator.take_exploration_state().home.tolist() == [1.5, 2.5]


def test_visited_and_given_up_places_move_with_the_map():
    robot = exploring_robot()
    robot.explore((3.0, 2.5))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due)
    arrival = robot.pose
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due, moves=False)
    robot.use_map(map_with((2.0, 2.9, 0.0)))  # a loop closure moves all by 0.4 m
    exploration_state = robot.navigator.take_exploration_state()
    np.testing.assert_allclose(exploration_state.arrivals, arrival[None] + np.array([0.0, 0.4, 0.0]))
    np.testing.assert_allclose(exploration_state.unreachable, [[8.0, 2.9]])


def test_a_given_up_place_moves_with_its_surroundings():
    """Not with the robot, which is metres away."""
    robot = exploring_robot()
    robot.use_map(map_with((7.0, 2.5, 0.0), START))
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.navigator.explorer.viewpoint_due, moves=False)
    robot.use_map(map_with((7.0, 2.9, 0.0), START))
    np.testing.assert_allclose(robot.navigator.take_exploration_state().unreachable, [[8.0, 2.9]])


def test_a_map_that_began_again_ends_it():
    robot = exploring_robot()
    robot.use_map(map_with(START, (3.0, 2.5, 0.0)))
    robot.step()
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.pose[0] > 3.0)
    robot.use_map(map_with(START))
    status = robot.step()
    assert (status.exploration.phase, status.refused) == ("failed", True)
    assert "mapping has started again" in status.reason
    place = robot.pose
    for _ in range(SCANS_PER_S):
        robot.step()
    assert np.hypot(*(robot.pose - place)[:2]) < 0.6  # it has braked


def test_a_jump_with_the_map_is_no_driving():
    robot = exploring_robot()
    robot.explore((8.0, 2.5))
    robot.until(lambda _: robot.pose[0] > 3.0)
    driven = robot.step().exploration.path
    robot.pose = robot.pose + np.array([0.5, 0.0, 0.0])
    assert robot.step().exploration.path < driven + 0.2


def test_a_viewpoint_that_did_not_move_with_the_map_is_not_given_up():
    robot = exploring_robot()
    robot.explore((6.0, 2.5))
    robot.until(lambda _: robot.pose[0] > 3.0)
    values = GRID.values.copy()
    values[40:60, 105:135] = OCCUPIED  # at the viewpoint's old coordinates
    grid = OccupancyGrid.of(values, GRID.resolution, (0.0, 0.0, 0.0))
    moved = Map(stamp_ns=0, grid=grid, poses=np.array([START]) + np.array([1.0, 0.0, 0.0]))
    robot.use_map(PlanningMap.of(moved, 0.27))
    robot.until(lambda _: robot.navigator.goal_state.phase is Phase.REFUSED)
    assert robot.navigator.explorer.viewpoint_due
    assert len(robot.navigator.take_exploration_state().unreachable) == 0


def test_a_goal_in_a_map_that_began_again():
    """Its coordinates mean another place now."""
    robot = PerfectRobot()
    robot.use_map(map_with(START, (3.0, 2.5, 0.0)))
    robot.navigator.on_goal(goal(8, 2.5))
    robot.until(lambda _: robot.pose[0] > START[0] + 0.5)
    robot.use_map(map_with(START, (3.0, 2.5, 0.0), (4.0, 2.5, 0.0)))
    assert robot.step().state == "navigating"
    robot.use_map(map_with(START))
    status = robot.step()
    assert status.refused
    assert "mapping has started again: send the goal again" in status.reason
    assert robot.until(lambda _: not robot.navigator._command.velocity.any()).refused
