"""Dead reckoning with drift (Thrun et al. 2005, chapter 5.4).

There the variances are quadratic in one step's motion; here they grow with the distance travelled, so that the drift
over a metre does not depend on how often the wheels are read.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array


@dataclass(frozen=True)
class Drift:
    """Variance gained by motion."""

    turn_by_turn: float = 1e-3  # alpha 1, rad²/rad
    turn_by_path: float = 5e-4  # alpha 2, rad²/m
    path_by_path: float = 1e-3  # alpha 3, m²/m
    path_by_turn: float = 1e-4  # alpha 4, m²/rad


class Odometer:
    """The pose in odom, from true motion and noise."""

    def __init__(self, drift: Drift, rng: np.random.Generator) -> None:
        """At the origin of odom, certain."""
        self.drift, self._rng = drift, rng
        self.pose, self.covariance = np.zeros(3), np.zeros((3, 3))

    def move(self, before: Array, after: Array) -> None:
        """The robot went from one true pose (3,) to another."""
        step = se2.between(before, after)
        path, turn = float(np.hypot(step[0], step[1])), abs(float(step[2]))
        drift = self.drift
        along = drift.path_by_path * path + drift.path_by_turn * turn
        around = drift.turn_by_turn * turn + drift.turn_by_path * path
        spread = np.array([along, along, around])
        noisy = step + np.sqrt(spread) * self._rng.standard_normal(3)
        by_pose, by_step = se2.compose_jacobians(self.pose, noisy)
        self.covariance = by_pose @ self.covariance @ by_pose.T + by_step @ np.diag(spread) @ by_step.T
        self.pose = se2.compose(self.pose, noisy)
