"""Goals on the floors of a building, with and without a lift between them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry.occupancy_grid import FREE, OccupancyGrid
from common.messages.definitions import Map, Status
from common.messages.topics import GOAL, STATUS
from common.robot.robot import Robot
from services.controller.growing_map import PlanningMap
from services.controller.lifts import RIDE_LENGTH_M, LiftRide, plan_ride
from services.controller.navigator import Navigator
from services.controller.policies.planner import GeodesicPolicy
from services.controller.service import ControllerService
from services.controller.settings import ControllerSettings
from tests.common.geometry.maps import building
from tests.controller.driving import PERIOD_NS, belief, goal, room, scan, session

FLOORS = {"ground": room(6, 4), "first": room(5, 4)}
LIFTS = [{"ground": (5, 2), "first": (4, 3)}, {"ground": (1, 3.5), "first": (1, 3)}]
TOWER, STAIRS = building(LIFTS, **FLOORS), building(**FLOORS)
FIRST = TOWER.floor("first")
START = [1.5, 1, 0]


@pytest.fixture(params=["geodesic", "paper"])
def make(request):
    """A function that creates a navigator of either preset for a world."""

    def of(world):
        policy = GeodesicPolicy(Robot(), world) if request.param == "geodesic" else None
        return Navigator(world=world, chosen_policy=policy)

    return of


def reasons(log):
    return [status.reason for _, status, _ in log]


def test_goal_in_the_frame_of_a_floor(make):
    navigator = make(TOWER)
    navigator.on_goal(goal(4, 1, map_id="first"))
    log = session(navigator, FIRST.to_map([1, 1, 0]), [None] * 220, TOWER)
    assert log[-1][1].state == "reached"
    np.testing.assert_allclose(FIRST.from_map(log[-1][2])[:2], [4, 1], atol=0.02)
    np.testing.assert_allclose(FIRST.from_map(log[-1][1].goal.array()), [4, 1, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ((4.9, 1), "(4.90, 1.00) on floor 'first' in tower is 0.10 m from a wall"),
        ((-3, 1), "(-3, 1) is not on floor 'first', which reaches from (0, 0) to (5, 4) m"),
    ],
)
def test_refusal_in_the_frame_of_a_floor(make, place, message):
    navigator = make(TOWER)
    for pose in (FIRST.to_map([1, 1, 0]), START):  # also from another floor
        session(navigator, pose, [None], TOWER)
        navigator.on_goal(goal(*place, map_id="first"))
        assert message in navigator.status(0).reason


def test_nearest_place_in_the_frame_of_a_floor():
    navigator = Navigator(world=TOWER, chosen_policy=GeodesicPolicy(Robot(), TOWER))
    session(navigator, FIRST.to_map([1, 1, 0]), [None], TOWER)
    navigator.on_goal(goal(4.9, 1, map_id="first"))
    assert "the nearest place that can be reached is (4.65, 0.95) on floor 'first'" in navigator.status(0).reason


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (TOWER, "there is no floor 'attic': choose one of ground, first"),
        (FLOORS["ground"], "no floor 'attic': world 'room' has no floors"),
        (None, "there is no map with floors"),
    ],
)
def test_unknown_floor(world, message):
    navigator = Navigator(world=world)
    navigator.on_goal(goal(1, 1, map_id="attic"))
    command, status = navigator.step(belief(0, START))
    assert (status.refused, command.twist.array().any()) == (True, False)
    assert message in status.reason


def test_ride(make):
    """The robot drives to the lift with the shorter way, waits there, and drives on when it is found on the floor."""
    navigator = make(TOWER)
    session(navigator, START, [None], TOWER)
    navigator.on_goal(goal(4, 1, map_id="first"))
    log = session(navigator, START, [None] * 150, TOWER, first=1)
    _, status, pose = log[-1]
    assert reasons(log)[0] == "driving to the lift to floor 'first'"
    assert (status.state, status.reason) == ("navigating", "waiting to be taken to floor 'first'")
    assert np.hypot(*(pose[:2] - [5, 2])) <= 0.1
    assert status.distance is None
    session(navigator, pose, [None] * 40, TOWER, first=151, state="lost")
    log = session(navigator, FIRST.to_map([4, 3, 2]), [None] * 220, TOWER, first=191)
    assert log[-1][1].state == "reached"
    np.testing.assert_allclose(FIRST.from_map(log[-1][2])[:2], [4, 1], atol=0.02)
    assert not any("lift" in reason for reason in reasons(log))


def test_belief_that_came_late(make):
    """The first belief on the other floor is of a scan that is no longer the latest."""
    navigator = make(TOWER)
    session(navigator, START, [None], TOWER)
    navigator.on_goal(goal(4, 1, map_id="first"))
    navigator.on_scan(scan(3 * PERIOD_NS, FIRST.to_map([4, 3, 2]), TOWER))
    _, status = navigator.step(belief(2 * PERIOD_NS, FIRST.to_map([4, 3, 2])))
    assert (status.state, status.refused) == ("navigating", False)


def test_goal_before_the_robot_is_localised(make):
    navigator = make(TOWER)
    navigator.on_goal(goal(4, 1, map_id="first"))
    log = session(navigator, START, [None] * 3, TOWER, state="localising")
    assert not log[-1][1].refused
    log = session(navigator, START, [None], TOWER, first=3)
    assert reasons(log) == ["driving to the lift to floor 'first'"]


def test_taken_to_a_wrong_floor():
    """It takes the lift back."""
    navigator = Navigator(world=TOWER)
    navigator.on_goal(goal(4, 1, map_id="ground"))
    log = session(navigator, FIRST.to_map([2, 1, 0]), [None] * 2, TOWER)
    assert reasons(log)[-1] == "driving to the lift to floor 'ground'"


def test_two_lifts_in_a_row(make):
    """The robot is taken to a floor on the way, and drives to the second lift there."""
    lifts = [{"ground": (5, 2), "first": (4, 3)}, {"first": (1, 1), "second": (1, 2)}]
    tower = building(lifts, **FLOORS, second=room(5, 4))
    navigator, second = make(tower), tower.floor("second")
    session(navigator, START, [None], tower)
    navigator.on_goal(goal(4, 2, map_id="second"))
    log = session(navigator, START, [None] * 150, tower, first=1)
    assert reasons(log)[-1] == "waiting to be taken to floor 'first'"
    log = session(navigator, tower.floor("first").to_map([4, 3, 2]), [None] * 200, tower, first=151)
    assert reasons(log)[-1] == "waiting to be taken to floor 'second'"
    log = session(navigator, second.to_map([1, 2, 0]), [None] * 200, tower, first=351)
    assert log[-1][1].state == "reached"
    np.testing.assert_allclose(second.from_map(log[-1][2])[:2], [4, 2], atol=0.02)


def test_goal_at_a_lift():
    navigator = Navigator(world=TOWER)
    session(navigator, START, [None], TOWER)
    navigator.on_goal(goal(1, 3, map_id="first"))
    log = session(navigator, START, [None], TOWER, first=1)
    assert reasons(log) == ["driving to the lift to floor 'first'"]


@given(st.integers(0, 2**32 - 1))
def test_shortest_way(seed):
    """It is at most as long as that through any other two lifts."""
    rng = np.random.default_rng(seed)
    names = [f"floor-{k}" for k in range(4)]
    lifts = [{str(name): tuple(rng.uniform(1, 3, 2)) for name in rng.choice(names, 2, replace=False)} for _ in range(5)]
    tower = building(lifts, **{name: room(6, 4) for name in names})
    start, end = tower.floor(names[0]).to_map([1, 1]), tower.floor(names[3]).to_map([5, 3])
    ride = plan_ride(tower, start, end, lambda place: None)

    def length(place, floor, used):
        """Length of the shortest way, by enumeration."""
        ways = [np.hypot(*(end - place))] if floor == names[3] else []
        for number in set(range(5)) - used:
            if floor in lifts[number]:
                (other,) = set(lifts[number]) - {floor}
                enter, leave = (tower.floor(name).to_map(lifts[number][name]) for name in (floor, other))
                way = np.hypot(*(enter - place)) + RIDE_LENGTH_M
                ways.append(way + length(leave, other, {*used, number}))
        return min(ways, default=np.inf)

    shortest = length(start, names[0], set())
    assert isinstance(ride, str) == np.isinf(shortest)
    if isinstance(ride, LiftRide):
        (number,) = (
            k
            for k, lift in enumerate(lifts)
            if names[0] in lift and np.allclose(tower.floor(names[0]).to_map(lift[names[0]]), ride.place)
        )
        leave = tower.floor(ride.floor).to_map(lifts[number][ride.floor])
        way = np.hypot(*(ride.place - start)) + RIDE_LENGTH_M + length(leave, ride.floor, {number})
        assert way == pytest.approx(shortest, abs=1e-3)


def test_no_lift(make):
    navigator = make(STAIRS)
    session(navigator, START, [None], STAIRS)
    navigator.on_goal(goal(4, 1, map_id="first"))
    ((command, status, _),) = session(navigator, START, [None], STAIRS, first=1)
    assert (status.refused, command.twist.array().any()) == (True, False)
    assert "it is on floor 'first', the robot is on floor 'ground', and no lifts connect the two" in status.reason


def test_no_lift_and_carried_by_hand(make):
    """A goal sent while the robot is lost is judged when it is found again."""
    navigator = make(STAIRS)
    session(navigator, START, [None], STAIRS)
    session(navigator, FIRST.to_map([1, 1, 0]), [None], STAIRS, first=1, state="lost")
    navigator.on_goal(goal(4, 1, map_id="first"))
    log = session(navigator, FIRST.to_map([1, 1, 0]), [None] * 220, STAIRS, first=2)
    assert log[-1][1].state == "reached"
    navigator.on_goal(goal(4, 1, map_id="ground"))
    ((_, status, _),) = session(navigator, log[-1][2], [None], STAIRS, first=222)
    assert "no lifts connect the two" in status.reason


def test_lift_that_cannot_be_reached(make):
    narrow = building([{"ground": (0.1, 2), "first": (4, 3)}], **FLOORS)
    navigator = make(narrow)
    session(navigator, START, [None], narrow)
    navigator.on_goal(goal(4, 1, map_id="first"))
    message = "the lift to floor 'first' cannot be reached: (0.10, 2.00) on floor 'ground' in tower is 0.10 m"
    assert message in navigator.status(0).reason


def test_farther_lift_if_the_nearer_one_cannot_be_reached(make):
    two = building([{"ground": (0.1, 2), "first": (4, 3)}, *LIFTS], **FLOORS)
    navigator = make(two)
    session(navigator, START, [None], two)
    navigator.on_goal(goal(4, 1, map_id="first"))
    _, _, pose = session(navigator, START, [None] * 150, two, first=1)[-1]
    assert np.hypot(*(pose[:2] - [5, 2])) <= 0.1


def test_docking_on_another_floor():
    navigator = Navigator(chosen_policy=GeodesicPolicy(Robot(), TOWER), world=TOWER)
    session(navigator, START, [None], TOWER)
    navigator.on_goal(goal(4, 1, map_id="first", approach=0.0))
    _, status, _ = session(navigator, START, [None] * 150, TOWER, first=1)[-1]
    assert status.reason == "waiting to be taken to floor 'first'"
    log = session(navigator, FIRST.to_map([4, 3, 2]), [None] * 300, TOWER, first=151)
    assert log[-1][1].state == "reached"
    np.testing.assert_allclose(FIRST.from_map(log[-1][2])[:2], [4, 1], atol=0.02)


@pytest.mark.parametrize(("floor", "resumed"), [("first", True), ("attic", False)])
def test_goal_is_resumed(floor, resumed):
    service = ControllerService(ControllerSettings(preset="paper"))
    service.navigator = Navigator(world=TOWER)
    sent = goal(4, 1, map_id=floor, seq=7)
    status = Status(stamp_ns=0, state="navigating", goal=goal(*FIRST.to_map([4, 1])).pose, goal_seq=7)
    service.on_restored({GOAL: sent, STATUS: status})
    assert service.navigator.goal_state.active == resumed


@pytest.mark.parametrize("replaced", [False, True])
def test_goal_is_resumed_while_mapping(replaced, monkeypatch):
    """At the first map: before, the goal would be refused."""
    service = ControllerService(ControllerSettings(world=""))
    policy = service.geodesic = GeodesicPolicy(Robot(), None)
    service.navigator = Navigator(chosen_policy=policy)
    status = Status(stamp_ns=0, state="navigating", goal=goal(4, 1).pose, goal_seq=7)
    service.on_restored({GOAL: goal(4, 1, seq=7), STATUS: status})
    assert service.navigator.goal_state.goal is None
    monkeypatch.setattr(service, "publish", lambda topic, message: None)
    if replaced:
        service.on_message(GOAL, goal(3, 1, seq=8))
    grid = OccupancyGrid.of(np.full((80, 120), FREE, np.uint8), 0.05, (0.0, 0.0, 0.0))
    service._use_map(PlanningMap.of(Map(stamp_ns=0, grid=grid, poses=np.array([START], float)), 0.27))
    goal_state = service.navigator.goal_state
    assert goal_state.goal.seq == (8 if replaced else 7)
    assert replaced or goal_state.active
