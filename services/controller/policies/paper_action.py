"""Preset `paper`: action by descent on the free energy (equation 4).

docs/method.md derives it. A belief contains its pose, the prediction error xi at that pose (weighted by its precision
and mapped to the pose's coordinates) and the curvature H of the free energy F. The generative model itself is therefore
not needed here: to first order, the prediction error at another pose x' is xi - H (x' - pose).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array

MAX_CORRECTION_M = 0.3  # the first-order expansion around the belief is not trusted farther away


@dataclass(frozen=True)
class ActionParameters:
    """Parameters of the paper's goal attractor and action step, in physical units."""

    gamma: float = 0.3  # action step size per scan
    horizon: float = 1.0  # s, d(pose)/d(action): how long a velocity is assumed to be held
    reach: float = 2.0  # m, upper limit of the goal's attraction
    action_precision: float = 1.0  # s²/m², if the pose's is 1/m²; prior on zero velocity, which damps the motion


def observed_position(
    pose: Array, xi: npt.NDArray[np.floating[Any]] | None, curvature: npt.NDArray[np.float64] | None
) -> Array:
    """Position (2,) m according to the scan: the belief plus its natural-gradient step H^-1 xi.

    Along directions about which the scan has little information (H nearly singular), it stays that of the belief; also
    if the estimator does not compute xi or H.
    """
    if xi is None or curvature is None:
        return np.array(pose[:2])
    H = curvature[:2, :2]
    damped = H + 1e-3 * max(float(np.trace(H)), 1e-9) * np.eye(2)
    step = np.linalg.solve(damped, xi[:2].astype(np.float64))
    return np.asarray(pose[:2] + step * min(1.0, MAX_CORRECTION_M / max(float(np.hypot(*step)), 1e-12)))


def preferred_position(observed: Array, goal: Array, reach: float) -> Array:
    """Position (2,) m moved towards the goal by at most ``reach`` m: the goal's term of equation 3, bounded."""
    to_goal = goal[:2] - observed
    return np.asarray(observed + to_goal * min(1.0, reach / max(float(np.hypot(*to_goal)), 1e-12)))


def action_gradient(
    action: Array, observed: Array, preferred: Array, yaw: float, parameters: ActionParameters
) -> Array:
    """Gradient dF/da (2,). Its negative is the direction of equation 4.

    With T the horizon, F(a) = |observed + T R(yaw) a - preferred|² / 2 + action_precision T² |a|² / 2, in units of the
    pose's precision: the distance of the outcome from the preferred position, and the effort.
    """
    outcome = observed + parameters.horizon * se2.rotate(yaw, action)
    effort = parameters.action_precision * parameters.horizon**2
    return np.asarray(parameters.horizon * se2.rotate(-yaw, outcome - preferred) + effort * action)


def next_action(action: Array, observed: Array, preferred: Array, yaw: float, parameters: ActionParameters) -> Array:
    """Velocity (2,) m/s in base_link after one step of equation 4."""
    return np.asarray(action - parameters.gamma * action_gradient(action, observed, preferred, yaw, parameters))
