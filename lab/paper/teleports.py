"""The paper's algorithm 1.

Without speed limit and physics: an action is a displacement in m, as in the thesis behind the paper. The robot stays in
free space, though: a displacement into a wall ends before the wall, and the action is reset to zero there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely

from common.geometry.se2 import Array
from common.geometry.world import World
from common.robot.robot import Robot
from lab.experiments.start_and_goal import ARRIVAL_DISTANCE, StartAndGoal
from services.estimator.paper.decoder import PaperModel
from services.estimator.paper.free_energy import FreeEnergy

# "sum" sums the action over iterations, as equation 4 does. "step" takes the gradient alone as the displacement, so the
# motion decays with the gradient, as the paper describes. "printed" uses the signs of both equations as printed.
Form = Literal["step", "sum", "printed"]


@dataclass(frozen=True)
class StepSizes:
    """Step sizes; alpha and gamma in m², with Sigma = 1 m².

    The paper's network and its gradients use coordinates in which the map is 2 x 2. In metres, a step along an axis is
    therefore scaled by the square of the map's half size along that axis. alpha and gamma apply to the longest axis;
    across the 18 m x 4.5 m corridor the steps are 16 times smaller.
    """

    alpha: float = 5e-4  # m², of perception
    beta: float = 1.0  # weight of the goal
    gamma: float = 5e-4  # m², of action
    form: Form = "step"
    normalised: bool = True  # whether steps scale with the map's size as above; otherwise they are equal on both axes


@dataclass(frozen=True)
class TeleportOutcome:
    """Result of driving by teleports; entry k of the arrays is from before iteration k + 1."""

    distance: Array  # (K,) m, robot to goal
    error: Array  # (K,) m, belief to robot
    stopped: int  # number of displacements that ended before a wall

    @property
    def reached(self) -> bool:
        """Whether the robot came within `ARRIVAL_DISTANCE` of the goal."""
        return bool(self.distance[-1] <= ARRIVAL_DISTANCE)

    @property
    def iterations(self) -> int:
        """Number of iterations."""
        return len(self.distance) - 1


def travel(
    ends: StartAndGoal,
    steps: StepSizes,
    model: PaperModel,
    look: Callable[[Array], Array],
    world: World,
    yaw: float,
    limit: int,
) -> TeleportOutcome:
    """Runs algorithm 1 with the belief starting at the true start, for at most ``limit`` iterations.

    ``look`` returns usable ranges (B,), m, with fresh noise at a pose (3,).
    """
    room = shapely.buffer(world.free_space, -Robot().radius)
    shapely.prepare(room)
    goal, robot = np.array(ends.goal), np.array(ends.start)
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
    return TeleportOutcome(np.array(distances), np.array(errors), stopped)


def _perceive(o: Array, belief: Array, g_goal: Array, model: PaperModel, steps: StepSizes, yaw: float) -> Array:
    """The bracket of equation 3, (2,)."""
    g, dg = model.predict(np.array([*belief, yaw]))
    if steps.form == "printed":
        return np.asarray((dg.T @ (o - g) + steps.beta * (dg.T @ (o - g_goal)))[:2])
    return FreeEnergy(o, g, dg, np.ones(len(o)), g_goal, steps.beta).descent[:2]


def _act(
    action: Array, o: Array, belief: Array, model: PaperModel, steps: StepSizes, yaw: float, metric: Array
) -> Array:
    """The action (2,), m, of equation 4 at the updated belief.

    The heading is fixed, so the derivative of the belief by the displacement is the identity.
    """
    g, dg = model.predict(np.array([*belief, yaw]))
    xi = metric * (dg.T @ (o - g))[:2]
    if steps.form == "printed":
        return np.asarray(action + steps.gamma * xi)
    return np.asarray(-steps.gamma * xi + (action if steps.form == "sum" else 0.0))


def displace(room: shapely.Geometry, place: Array, step: Array) -> tuple[Array, bool]:
    """The place (2,) after a step (2,), m, or the last place on the line that lies in ``room``.

    Also returns whether the step was shortened.
    """
    if shapely.covers(room, shapely.LineString(np.array([place, place + step]))):
        return place + step, False
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        free = shapely.covers(room, shapely.LineString(np.array([place, place + middle * step])))
        low, high = (middle, high) if free else (low, middle)
    return place + low * step, True
