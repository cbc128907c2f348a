"""The robot and its world without a physics engine: the robot moves as commanded, and a contact stops it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from common.geometry.ray_casting import cast_rays
from services.simulator.physics import SUBSTEP_S

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import Obstacle, World
    from common.robot.robot import Robot


class Kinematics:
    """Physics without an engine: the robot moves at the velocity that `Actuator` computes, until a contact stops it.

    A step that would bring the robot's body nearer than its radius to a wall, a piece of furniture or a person is not
    taken, but the robot may turn. pybullet's robot slides along the wall instead.
    """

    def __init__(self, world: World, robot: Robot, pose: Array) -> None:
        """Builds the world without its furniture, and puts the robot at ``pose`` (3,)."""
        self._world, self._radius = world.with_obstacles([]), robot.radius
        self._furniture: dict[str, Obstacle] = {}
        self._people = np.zeros((0, 3))  # x, y, radius in m
        self.place(pose)

    def close(self) -> None:
        """See Physics."""

    def add(self, name: str, obstacle: Obstacle) -> None:
        """See Physics."""
        self._furniture[name] = obstacle
        self._world = self._world.with_obstacles(list(self._furniture.values()))

    def remove(self, name: str) -> None:
        """See Physics."""
        del self._furniture[name]
        self._world = self._world.with_obstacles(list(self._furniture.values()))

    def add_people(self, places: Array, radius: float) -> None:
        """See Physics."""
        self._people = np.column_stack([places, np.full(len(places), radius)])

    def move_people(self, places: Array) -> None:
        """See Physics."""
        self._people[:, :2] = places

    def place(self, pose: Array) -> None:
        """See Physics."""
        self._pose, self._velocity = np.array(pose, float), np.zeros(3)  # the velocity is in map

    def pose(self) -> Array:
        """See Physics."""
        return np.array([*self._pose[:2], float(se2.wrap(self._pose[2]))])

    def twist(self) -> Array:
        """See Physics."""
        return np.array([*se2.rotate(-self._pose[2], self._velocity[:2]), self._velocity[2]])

    def drive(self, twist: Array) -> bool:
        """See Physics."""
        self._velocity = np.array([*se2.rotate(self._pose[2], twist[:2]), twist[2]])
        step = self._velocity * SUBSTEP_S
        # A robot that is too near already, because a person walked into it, may move away.
        here, ahead = self._distances(np.array([self._pose[:2], self._pose[:2] + step[:2]]))
        contact = bool(ahead < self._radius and ahead < here)
        if contact:
            self._velocity[:2] = step[:2] = 0.0
        self._pose = self._pose + step
        return contact

    def _distances(self, points: Array) -> Array:
        """Distances (N,) in m from points (N, 2) to the nearest surface; negative behind it."""
        offsets = points[:, None] - self._people[:, :2]
        people = np.hypot(offsets[..., 0], offsets[..., 1]) - self._people[:, 2]
        return np.asarray(np.minimum(self._world.surface_distance(points), people.min(axis=1, initial=np.inf)))

    def ranges(self, lasers: Array, angles: Array, reach: float, *, people: bool = True) -> Array:
        """See Physics."""
        ranges = cast_rays(self._world, lasers, angles, self._people if people else None)
        return np.where(ranges <= reach, ranges, np.inf)
