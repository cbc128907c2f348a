"""The plan of the stub's robot: goal field, path, motion, people and unmapped obstacles."""

from __future__ import annotations

import numpy as np

from common.geometry.world import World
from common.messages.definitions import Pose, Preference
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.geodesic_field import CostField, FreeSpaceGraph
from services.viewer.state.goal_field import field_of

RADIUS = 0.27  # m


class Planner:
    """Plans paths in a world."""

    def __init__(self, world: World) -> None:
        """Without a goal."""
        self.graph = FreeSpaceGraph(FreeSpace.of(world), RADIUS)
        self.goal: np.ndarray | None = None
        self.field: CostField | None = None
        self.news: bytes | None = None  # the encoded field of the goal

    def aim(self, goal: np.ndarray, t: float) -> None:
        """Sets the goal (2,) in m at time ``t`` in s."""
        if self.goal is not None and np.allclose(goal, self.goal):
            return
        self.goal, self.field = goal, self.graph.cost_field(goal)
        if self.field is None:
            return
        grid = self.graph.grid
        message = Preference(
            stamp_ns=int(t * 1e9), goal=Pose(x=goal[0], y=goal[1]), origin=Pose(x=grid.origin[0], y=grid.origin[1]),
            resolution=grid.resolution, width=grid.shape[1], height=grid.shape[0],
            distance=self.field.cost.ravel().astype(np.float32),
        )  # fmt: skip
        self.news = field_of(message, "robot")

    def path(self, place: np.ndarray) -> np.ndarray:
        """Path (K, 2) in m from a place to the goal."""
        return self.field.path(place) if self.field is not None else np.zeros((0, 2))


def motion(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Places (T, 2) in m of a robot that brakes at 1 m/s² from a velocity (3,) in base_link."""
    speed = float(np.hypot(*twist[:2]))
    heading = pose[2] + np.arctan2(twist[1], twist[0])
    times = np.linspace(0, speed, 12)
    way = speed * times - times**2 / 2
    bent = heading + 0.5 * twist[2] * times
    return np.stack([pose[0] + way * np.cos(bent), pose[1] + way * np.sin(bent)], axis=1)


def people(t: float, world: World) -> np.ndarray:
    """Places (3, 2) in m of three people who walk up and down."""
    x0, y0, x1, y1 = world.bounds
    share = 0.5 + 0.4 * np.sin(0.3 * t + np.array([0.0, 2.0, 4.0]))
    across = np.array([0.5, 0.45, 0.55])
    return np.stack([x0 + share * (x1 - x0), y0 + across * (y1 - y0)], axis=1)


def seen_of(people: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Points (M, 2) in m on the sides of near people that face the robot."""
    around = np.linspace(-1.2, 1.2, 9)
    sides = []
    for person in people:
        if np.hypot(*(person - place)) < 5:
            towards = np.arctan2(*(place - person)[::-1])
            sides.append(person + 0.25 * np.stack([np.cos(towards + around), np.sin(towards + around)], axis=1))
    return np.concatenate(sides) if sides else np.zeros((0, 2))
