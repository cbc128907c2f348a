"""Goals on another floor: which lift to take, and the wait until the robot has been taken there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from common.geometry.se2 import Array
    from common.geometry.world import World

LIFT_TOLERANCE_M = 0.1  # the robot waits within this distance of the lift's place
MIN_EDGE_M = 1e-6  # added to each edge, as scipy takes 0 for no connection
RIDE_LENGTH_M = 20.0  # a ride costs as much as driving this distance (a guess)


@dataclass(frozen=True)
class LiftRide:
    """A lift from the robot's floor to the goal's, or to one on the way there."""

    place: Array  # (2,) m in map, of the lift on the robot's floor
    floor: str  # at which the robot leaves the lift

    def is_at_lift(self, pose: Array) -> bool:
        """Whether the robot at ``pose`` (3,) is at the lift."""
        return bool(np.hypot(*(pose[:2] - self.place)) <= LIFT_TOLERANCE_M)

    def reason(self, pose: Array) -> str:
        """Status text of the robot at ``pose`` (3,)."""
        if self.is_at_lift(pose):
            return f"waiting to be taken to floor {self.floor!r}"
        return f"driving to the lift to floor {self.floor!r}"


def plan_ride(world: World, place: Array, goal: Array, refusal: Callable[[Array], str | None]) -> LiftRide | str | None:
    """The first ride on the shortest way, in straight lines, from a ``place`` (2,) to a goal (2,) on another floor.

    ``refusal`` returns the reason why a lift (2,) cannot be reached from here, or None if it can. Returns None if the
    goal is on the same floor, and the reason to refuse it if no lifts lead there.
    """
    here, there = world.floor_at(place), world.floor_at(goal)
    if here is None or there is None or here.name == there.name:
        return None
    from scipy.sparse.csgraph import dijkstra  # slow, and needed only with floors

    # A graph of all places where a lift stops, and the goal as its last node. Its edges are ways on a floor, and rides.
    stops = [(number, name) for number, lift in enumerate(world.lifts) for name in lift]
    places = np.array([*(world.floor(name).to_map(world.lifts[number][name]) for number, name in stops), goal[:2]])
    lifts = np.array([*(number for number, _ in stops), -1])
    floors = np.array([*(name for _, name in stops), there.name])
    distance = np.hypot(*(places[:, None] - places).transpose(2, 0, 1)) + MIN_EDGE_M
    same_floor = (floors[:, None] == floors) & (floors != here.name)  # here, the robot drives to the first lift only
    length = np.where(same_floor, distance, np.where(lifts[:, None] == lifts, RIDE_LENGTH_M, np.inf))
    to_goal, following = dijkstra(length, directed=False, indices=len(stops), return_predecessors=True)
    rides = [k for k in range(len(stops)) if floors[k] == here.name and np.isfinite(to_goal[k])]
    if not rides:
        return f"it is on floor {there.name!r}, the robot is on floor {here.name!r}, and no lifts connect the two"
    rides.sort(key=lambda k: np.hypot(*(places[k] - place[:2])) + to_goal[k])
    problems = []
    for k in rides:
        ride = LiftRide(places[k], str(floors[following[k]]))
        if (problem := refusal(ride.place)) is None:
            return ride
        problems.append(f"the lift to floor {ride.floor!r} cannot be reached: {problem}")
    return problems[0]
