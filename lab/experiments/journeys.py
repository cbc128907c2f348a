"""Random start and goal pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from common.errors import UserError
from common.geometry.se2 import Array
from common.geometry.world import World
from common.robot.base import Robot

CLOSE = 0.8  # m, there: the paper's range of the target
APART = 12.0  # m, between start and goal at least
# m between robot and anything along the line. The obstacle stop (`safety`) looks 1 cm beside the robot and
# keeps 5 cm before it; the rest is seven times the scanner's noise, so that on this line it never acts.
CLEARANCE = 0.15
TRIES = 20_000


@dataclass(frozen=True)
class Journey:
    """From standing at ``start`` to within `CLOSE` of ``goal``, m."""

    start: tuple[float, float]
    goal: tuple[float, float]
    too_near: int = 0  # pairs drawn before this one that were less than APART apart
    obstructed: int = 0  # and those far enough apart whose straight line is not free

    @property
    def straight(self) -> float:
        """M from start to goal."""
        return float(np.hypot(self.goal[0] - self.start[0], self.goal[1] - self.start[1]))


def draw_journey(
    world: World, rng: np.random.Generator, robot: Robot, apart: float = APART, *, free: bool = True
) -> Journey:
    """Uniform over pairs of places where the robot fits, of those ``apart`` m or more with a free line between.

    With ``free`` False the line between need not be. Places are rounded to whole millimetres, so that they pass through
    a command line unchanged. Raises UserError where there seems to be no such pair.
    """
    room = shapely.buffer(world.free_space, -(robot.radius + CLEARANCE))
    shapely.prepare(room)
    too_near = obstructed = 0
    for _ in range(TRIES // 256):
        places = np.round(world.sample_free(256, rng, robot.radius), 3)
        for start, goal in places.reshape(-1, 2, 2):
            if np.hypot(*(goal - start)) < apart:
                too_near += 1
            elif free and not shapely.covers(room, shapely.LineString(np.array([start, goal]))):
                obstructed += 1
            else:
                ends = [(float(x), float(y)) for x, y in (start, goal)]
                return Journey(ends[0], ends[1], too_near, obstructed)
    raise UserError(
        f"world {world.name!r}: no two places {apart:g} m apart with a free straight line for the robot between them"
    )


def least_time(distance: float, robot: Robot, close: float = CLOSE) -> float:
    """S from standstill until ``distance`` m shrank to ``close``: accelerate, cruise; nobody asks it to stop there."""
    way, v, a = max(0.0, distance - close), robot.max_speed, robot.acceleration
    return float(np.sqrt(2 * way / a)) if way < v**2 / (2 * a) else way / v + v / (2 * a)


def path_ratio(path: Array) -> float:
    """Length of a path (N, 2+) over the straight line between its ends; 1 where it never moved."""
    steps = np.hypot(*np.diff(path[:, :2], axis=0).T)
    straight = float(np.hypot(*(path[-1] - path[0])[:2]))
    return float(steps.sum()) / straight if straight > 0 else 1.0
