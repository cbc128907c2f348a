"""States of the robot during the last scan period, interpolated between the substeps of the physics."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array


@dataclass(frozen=True)
class MotionState:
    """The robot at one time; with a leading dimension, at several times."""

    pose: Array  # (3,) base_link in map
    wheels: Array  # (3,) pose according to the wheels, in a frame that drifts if they slip
    twist: Array  # (3,) in base_link


class RecentMotion:
    """The states of the last ``substeps`` substeps of ``substep_s`` s."""

    def __init__(self, pose: Array, substeps: int, substep_s: float) -> None:
        """Begins with a robot that has always stood at ``pose`` (3,)."""
        self._ages = substep_s * np.arange(-substeps, 1)
        self._states: deque[Array] = deque(maxlen=substeps + 1)
        self.place(pose)

    def place(self, pose: Array) -> None:
        """Replaces all states by a robot that has always stood at ``pose`` (3,)."""
        self._states.extend([np.concatenate([pose, pose, np.zeros(3)])] * len(self._ages))

    def add(self, pose: Array, wheels: Array, twist: Array) -> None:
        """Adds pose, wheel pose and twist, (3,) each, after one more substep."""
        self._states.append(np.concatenate([pose, wheels, twist]))

    @property
    def now(self) -> MotionState:
        """The state added last."""
        state = self._states[-1]
        return MotionState(state[:3], state[3:6], state[6:])

    def at(self, ages: Array) -> MotionState:
        """States ``ages`` (N,) s before the last one added, interpolated linearly."""
        states = np.array(self._states)
        states[:, [2, 5]] = np.unwrap(states[:, [2, 5]], axis=0)
        found = np.stack([np.interp(-ages, self._ages, column) for column in states.T], axis=-1)
        found[:, [2, 5]] = se2.wrap(found[:, [2, 5]])
        return MotionState(found[:, :3], found[:, 3:6], found[:, 6:])
