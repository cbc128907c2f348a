"""Preset `paper`: action by descent on the free energy (equation 4).

docs/method.md derives it. The belief carries its pose, xi and the curvature H of F there, so g need not be known here:
to first order the prediction error at another pose x' is xi - H (x' - pose).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array

MAX_CORRECTION = 0.3  # m, beyond it the expansion around the belief is not trusted


@dataclass(frozen=True)
class Preference:
    """The paper's goal attractor and action step, in units a robot has."""

    gamma: float = 0.3  # action step size a scan
    horizon: float = 1.0  # s, d(pose)/d(action): a velocity held that long
    reach: float = 2.0  # m, the goal attracts the belief by this much at most
    action_precision: float = 1.0  # s²/m² relative to the pose's 1/m²: prior that a robot stands; damps the sum


def observed_position(pose: Array, xi: Array, curvature: Array | None) -> Array:
    """(2,) m where the scan says the robot is: the belief plus its natural-gradient step H^-1 xi.

    A direction of which the scan says little (H near singular) keeps the belief.
    """
    if curvature is None:
        return np.array(pose[:2])
    H = curvature[:2, :2]
    damped = H + 1e-3 * max(float(np.trace(H)), 1e-9) * np.eye(2)
    step = np.linalg.solve(damped, xi[:2])
    return np.asarray(pose[:2] + step * min(1.0, MAX_CORRECTION / max(float(np.hypot(*step)), 1e-12)))


def preferred_position(observed: Array, goal: Array, reach: float) -> Array:
    """(2,) m: the belief drawn towards the goal, the goal's term of equation 3 with a bounded step."""
    towards = goal[:2] - observed
    return np.asarray(observed + towards * min(1.0, reach / max(float(np.hypot(*towards)), 1e-12)))


def action_free_energy(action: Array, observed: Array, preferred: Array, yaw: float, preference: Preference) -> float:
    """F(a) in units of the pose's precision: misfit of where the action leads to with what is preferred, and effort."""
    leads_to = observed + preference.horizon * se2.rotate(yaw, action)
    misfit, effort = leads_to - preferred, preference.action_precision * preference.horizon**2
    return float(0.5 * misfit @ misfit + 0.5 * effort * action @ action)


def action_gradient(action: Array, observed: Array, preferred: Array, yaw: float, preference: Preference) -> Array:
    """(2,) dF/da; minus it is the direction of equation 4 with the sign of descent."""
    leads_to = observed + preference.horizon * se2.rotate(yaw, action)
    effort = preference.action_precision * preference.horizon**2
    return np.asarray(preference.horizon * se2.rotate(-yaw, leads_to - preferred) + effort * action)


def next_action(action: Array, observed: Array, preferred: Array, yaw: float, preference: Preference) -> Array:
    """(2,) m/s in base_link after one step of equation 4."""
    return np.asarray(action - preference.gamma * action_gradient(action, observed, preferred, yaw, preference))
