"""The paper's algorithm 1.

No speed limit, no physics: an action is a displacement in m, as the thesis behind the paper has it. Only the body stays
in free space: a displacement that would leave it ends before the wall, and the action begins anew there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely

from common.geometry.se2 import Array
from common.geometry.world import World
from common.robot.base import Robot
from lab.experiments.journeys import ARRIVAL_DISTANCE, Journey
from services.estimator.paper.decoder import PaperModel
from services.estimator.paper.free_energy import gradient

# Equation 4 sums the action over iterations. "step" takes the gradient alone as the displacement: the velocity that
# dies away with the gradient, which the paper describes. "printed" has the printed signs of both equations.
Form = Literal["step", "sum", "printed"]


@dataclass(frozen=True)
class Steps:
    """Step sizes, m² each but beta; Sigma = 1 m².

    The paper's network, and so its gradients, are in coordinates in which the map is 2 x 2. Back in metres a step along
    each axis is scaled by the square of the map's half size there: alpha and gamma are those of the longest axis, and
    across an 18 m x 4.5 m corridor they are 16 times smaller.
    """

    alpha: float = 5e-4  # of perception
    beta: float = 1.0  # weight of the goal
    gamma: float = 5e-4  # of action
    form: Form = "step"
    normalised: bool = True  # False: the same step sizes along both axes


@dataclass(frozen=True)
class Outcome:
    """One journey; entry k is before iteration k+1."""

    distance: Array  # (K,) m, robot to goal
    error: Array  # (K,) m, belief to robot
    stopped: int  # displacements that a wall cut short

    @property
    def reached(self) -> bool:
        """Whether it came within `ARRIVAL_DISTANCE`."""
        return bool(self.distance[-1] <= ARRIVAL_DISTANCE)

    @property
    def iterations(self) -> int:
        """Made."""
        return len(self.distance) - 1


def travel(
    journey: Journey, steps: Steps, model: PaperModel, look: Callable[[Array], Array], world: World, yaw: float,
    limit: int,
) -> Outcome:  # fmt: skip
    """From the true start; ``look`` gives the usable ranges (B,) m seen from a pose (3,), with fresh noise."""
    room = shapely.buffer(world.free_space, -Robot().radius)
    shapely.prepare(room)
    goal, robot = np.array(journey.goal), np.array(journey.start)
    belief, action, metric = robot.copy(), np.zeros(2), model.norm.metric if steps.normalised else np.ones(2)
    x0, y0, x1, y1 = world.bounds
    g_goal = model.predict(np.array([*goal, yaw]))[0]
    distances, errors, stopped = [float(np.hypot(*(robot - goal)))], [0.0], 0
    while distances[-1] > ARRIVAL_DISTANCE and len(distances) <= limit:
        o = look(np.array([*robot, yaw]))
        belief = belief + steps.alpha * metric * _perceive(o, belief, g_goal, model, steps, yaw)
        belief = np.clip(belief, [x0, y0], [x1, y1])
        action = _act(action, o, belief, model, steps, yaw, metric)
        robot, cut = displace(room, robot, action)
        if cut:
            action, stopped = np.zeros(2), stopped + 1
        distances.append(float(np.hypot(*(robot - goal))))
        errors.append(float(np.hypot(*(robot - belief))))
    return Outcome(np.array(distances), np.array(errors), stopped)


def _perceive(o: Array, belief: Array, g_goal: Array, model: PaperModel, steps: Steps, yaw: float) -> Array:
    """(2,) the bracket of equation 3."""
    g, dg = model.predict(np.array([*belief, yaw]))
    if steps.form == "printed":
        return np.asarray((dg.T @ (o - g) + steps.beta * (dg.T @ (o - g_goal)))[:2])
    return gradient(o, g, dg, np.ones(len(o)), g_goal, steps.beta).descent[:2]


def _act(action: Array, o: Array, belief: Array, model: PaperModel, steps: Steps, yaw: float, metric: Array) -> Array:
    """(2,) m, equation 4 at the belief just updated; the heading is fixed, so a displacement moves the belief 1:1."""
    g, dg = model.predict(np.array([*belief, yaw]))
    xi = metric * (dg.T @ (o - g))[:2]
    if steps.form == "printed":
        return np.asarray(action + steps.gamma * xi)
    return np.asarray(-steps.gamma * xi + (action if steps.form == "sum" else 0.0))


def displace(room: shapely.Geometry, place: Array, step: Array) -> tuple[Array, bool]:
    """The place after a step (2,) m, or the last one on the way that lies in ``room``; whether it was cut short."""
    if shapely.covers(room, shapely.LineString(np.array([place, place + step]))):
        return place + step, False
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        free = shapely.covers(room, shapely.LineString(np.array([place, place + middle * step])))
        low, high = (middle, high) if free else (low, middle)
    return place + low * step, True
