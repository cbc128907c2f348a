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


@dataclass(frozen=True)
class LiftRide:
    """A lift from the robot's floor to the goal's."""

    place: Array  # (2,) m in map, of the lift on the robot's floor
    floor: str  # of the goal

    def is_at_lift(self, pose: Array) -> bool:
        """Whether the robot at ``pose`` (3,) is at the lift."""
        return bool(np.hypot(*(pose[:2] - self.place)) <= LIFT_TOLERANCE_M)

    def reason(self, pose: Array) -> str:
        """Status text of the robot at ``pose`` (3,)."""
        if self.is_at_lift(pose):
            return f"waiting to be taken to floor {self.floor!r}"
        return f"driving to the lift to floor {self.floor!r}"


def plan_ride(world: World, place: Array, goal: Array, refusal: Callable[[Array], str | None]) -> LiftRide | str | None:
    """The lift with the shortest way, in straight lines, from a ``place`` (2,) to a goal (2,) on another floor.

    ``refusal`` returns the reason why a lift (2,) cannot be reached from here, or None if it can. Returns None if the
    goal is on the same floor, and the reason to refuse it if no lift leads there.
    """
    here, there = world.floor_at(place), world.floor_at(goal)
    if here is None or there is None or here.name == there.name:
        return None
    ways = []
    for lift in world.lifts:
        if here.name in lift and there.name in lift:
            enter, leave = here.to_map(lift[here.name]), there.to_map(lift[there.name])
            ways.append((float(np.hypot(*(enter - place[:2])) + np.hypot(*(goal - leave))), enter))
    if not ways:
        return f"it is on floor {there.name!r}, the robot is on floor {here.name!r}, and no lift stops at both"
    ways.sort(key=lambda way: way[0])
    problems = []
    for _, enter in ways:
        if (problem := refusal(enter)) is None:
            return LiftRide(enter, there.name)
        problems.append(problem)
    return f"the lift to floor {there.name!r} cannot be reached: {problems[0]}"
