"""Random start and goal pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from common.errors import UserError
from common.geometry.se2 import Array
from common.geometry.world import World
from common.robot.robot import Robot

ARRIVAL_DISTANCE = 0.8  # m; closer than this counts as arrived, as in the paper
MIN_DISTANCE = 12.0  # m, between start and goal
# m between the robot and any obstacle along the line. The obstacle stop (`safety`) keeps a gap of 2 cm (`robot.margin`)
# beside and ahead of the robot; the rest is six times the scanner's noise, so that it never triggers on this line.
CLEARANCE = 0.15
MAX_DRAWS = 20_000


@dataclass(frozen=True)
class StartAndGoal:
    """Start and goal, in m. The robot begins at rest and must come within `ARRIVAL_DISTANCE` of the goal."""

    start: tuple[float, float]
    goal: tuple[float, float]
    too_near: int = 0  # rejected pairs that were too close together
    obstructed: int = 0  # rejected pairs that were far enough apart, but without a free straight line

    @property
    def straight(self) -> float:
        """Straight distance from start to goal in m."""
        return float(np.hypot(self.goal[0] - self.start[0], self.goal[1] - self.start[1]))


def draw_start_and_goal(
    world: World, rng: np.random.Generator, robot: Robot, apart: float = MIN_DISTANCE, *, free: bool = True
) -> StartAndGoal:
    """Draws uniformly from pairs of places that are ``apart`` m or more apart with a free straight line between them.

    With ``free`` False the line may be obstructed. Coordinates are rounded to whole millimetres, so that they pass
    through a command line unchanged. Raises UserError if no such pair is found.
    """
    room = shapely.buffer(world.free_space, -(robot.radius + CLEARANCE))
    shapely.prepare(room)
    too_near = obstructed = 0
    for _ in range(MAX_DRAWS // 256):
        places = np.round(world.sample_free(256, rng, robot.radius), 3)
        for start, goal in places.reshape(-1, 2, 2):
            if np.hypot(*(goal - start)) < apart:
                too_near += 1
            elif free and not shapely.covers(room, shapely.LineString(np.array([start, goal]))):
                obstructed += 1
            else:
                ends = [(float(x), float(y)) for x, y in (start, goal)]
                return StartAndGoal(ends[0], ends[1], too_near, obstructed)
    raise UserError(
        f"world {world.name!r}: no two places {apart:g} m apart with a free straight line for the robot between them"
    )


def least_time(distance: float, robot: Robot, close: float = ARRIVAL_DISTANCE, *, stop: bool = False) -> float:
    """Minimum time in s from standstill until a distance of ``distance`` m has shrunk to ``close`` m.

    The robot accelerates, and drives at full speed. At the end it need not stand, unless ``stop`` is true.
    """
    way, v, a, ramps = max(0.0, distance - close), robot.max_speed, robot.acceleration, 2 if stop else 1
    if way < ramps * v**2 / (2 * a):  # never at full speed
        return float(np.sqrt(2 * ramps * way / a))
    return way / v + ramps * v / (2 * a)


def path_ratio(path: Array) -> float:
    """Length of a path (N, 2+) divided by the distance between its ends; 1 if the ends coincide."""
    steps = np.hypot(*np.diff(path[:, :2], axis=0).T)
    straight = float(np.hypot(*(path[-1] - path[0])[:2]))
    return float(steps.sum()) / straight if straight > 0 else 1.0
