"""Actuator model of a base: latency, acceleration limits, dead band and wheel slip."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.runtime import safety

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.robot import Robot


class Actuator:
    """Motors and wheels. By default the base is ideal: it follows every command at once and exactly."""

    def __init__(self, robot: Robot, slip: float, rng: np.random.Generator) -> None:
        """``slip`` is the mean share of its motion that a wheel loses."""
        self.robot, self.slip, self._rng = robot, slip, rng
        self.velocity = np.zeros(3)  # (3,) set at the motors, within the acceleration limits
        self._target = np.zeros(3)
        self._waiting: list[tuple[float, Array]] = []  # time in s until a target takes effect, and the target
        self._grip = np.ones(3)  # share of its motion that each wheel, or each direction of a holonomic base, keeps

    def stop(self) -> None:
        """Stops the base at once, and discards all targets."""
        self.velocity, self._target, self._waiting = np.zeros(3), np.zeros(3), []

    def set_target(self, target: Array, *, at_once: bool) -> None:
        """Sets the target velocity (3,), which takes effect after the latency or ``at_once``. Draws new slip."""
        self._waiting = [] if at_once else self._waiting
        self._waiting.append((0.0 if at_once else self.robot.latency, target))
        if self.slip:
            self._grip = 1 - self._rng.uniform(0, 2 * self.slip, 3)

    def step(self, dt: float, *, hard: bool = False) -> tuple[Array, Array]:
        """Returns the velocities (3,) of the wheels and of the base over the next ``dt`` s.

        With ``hard``, brakes as hard as the base can.
        """
        while self._waiting and self._waiting[0][0] < dt / 2:
            self._target = self._waiting.pop(0)[1]
        self._waiting = [(wait - dt, target) for wait, target in self._waiting]
        self.velocity = safety.ramp(self.velocity, self._target, self.robot, dt, hard=hard)
        linear, turn = self.velocity[:2], self.velocity[2]
        wheels = np.array(
            [
                *(linear if np.hypot(*linear) >= self.robot.dead_band else np.zeros(2)),
                turn if abs(turn) >= self.robot.turn_dead_band else 0.0,
            ]
        )
        return wheels, self._slipping(wheels) if self.slip else wheels

    def _slipping(self, wheels: Array) -> Array:
        """Velocity (3,) of a base whose wheels roll with ``wheels`` (3,) and slip."""
        if self.robot.drive == "holonomic":
            return wheels * self._grip
        half_track = self.robot.radius  # m; the two wheels are assumed at the edge of the body
        left, right = (wheels[0] + np.array([-1, 1]) * half_track * wheels[2]) * self._grip[:2]
        return np.array([(left + right) / 2, 0.0, (right - left) / (2 * half_track)])
