"""Dead reckoning with drift (Thrun et al. 2005, chapter 5.4).

In the book the variances are quadratic in the motion of one step. Here they grow with the distance travelled, so that
the drift per metre does not depend on how often the wheels are read.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array


@dataclass(frozen=True)
class OdometryNoise:
    """Variance added per unit of motion."""

    turn_by_turn: float = 1e-3  # alpha 1, rad²/rad
    turn_by_path: float = 5e-4  # alpha 2, rad²/m
    path_by_path: float = 1e-3  # alpha 3, m²/m
    path_by_turn: float = 1e-4  # alpha 4, m²/rad


class Odometer:
    """Pose and covariance in odom, from the true motion and noise. Starts at the origin with zero covariance."""

    def __init__(self, drift: OdometryNoise, rng: np.random.Generator) -> None:
        self.drift, self._rng = drift, rng
        self.pose, self.covariance = np.zeros(3), np.zeros((3, 3))

    def move(self, before: Array, after: Array) -> None:
        """Adds the motion between two true poses (3,), with noise."""
        step = se2.between(before, after)
        path, turn = float(np.hypot(step[0], step[1])), abs(float(step[2]))
        drift = self.drift
        path_variance = drift.path_by_path * path + drift.path_by_turn * turn
        turn_variance = drift.turn_by_turn * turn + drift.turn_by_path * path
        variance = np.array([path_variance, path_variance, turn_variance])
        noisy = step + np.sqrt(variance) * self._rng.standard_normal(3)
        pose_jacobian, step_jacobian = se2.compose_jacobians(self.pose, noisy)
        noise = step_jacobian @ np.diag(variance) @ step_jacobian.T
        self.covariance = pose_jacobian @ self.covariance @ pose_jacobian.T + noise
        self.pose = se2.compose(self.pose, noisy)
