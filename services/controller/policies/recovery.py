"""Recovery of a robot that stands although it should drive: it backs off to where there is more room."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from services.controller.policies.motion_model import turn_to_lookahead
from services.controller.policies.motion_selection import SelectedMotion, Surroundings, select_motion

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.robot.robot import Robot

STUCK_AFTER_NS = 3_000_000_000  # time without motion after which the robot backs off
MAX_GAP_NS = 1_000_000_000  # after a longer time without a belief, the time without motion starts again
BACK_OFF_NS = 3_000_000_000  # how long it backs off
BACK_OFF_M = 0.4  # distance at which the gap to obstacles is compared between directions
BACKING_OFF = "stuck: backing off"  # status text


class Recovery:
    """Decides when the robot backs off."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Starts again, because the robot stands on purpose or has no goal."""
        self._standing_since_ns: int | None = None
        self._backing_off_since_ns: int | None = None

    def is_active(self, stamp_ns: int) -> bool:
        """Whether the robot backs off now."""
        return self._backing_off_since_ns is not None and 0 <= stamp_ns - self._backing_off_since_ns < BACK_OFF_NS

    def watch(self, stamp_ns: int, *, moving: bool) -> None:
        """Begins to back off after `STUCK_AFTER_NS` without motion; called with each decision to drive."""
        if moving:
            self.restart_timer()
        elif self._standing_since_ns is None or stamp_ns < self._standing_since_ns:
            self._standing_since_ns = stamp_ns
        elif stamp_ns - self._standing_since_ns > STUCK_AFTER_NS:
            self.begin(stamp_ns)

    def restart_timer(self) -> None:
        """Measures the time without motion from the next `watch` on."""
        self._standing_since_ns = None

    def begin(self, stamp_ns: int) -> None:
        """Begins to back off."""
        self._standing_since_ns, self._backing_off_since_ns = None, stamp_ns


def back_off(velocity: Array, surroundings: Surroundings, robot: Robot, period: float) -> SelectedMotion:
    """The motion towards the largest gap to walls and obstacles.

    ``velocity`` (3,) is the latest command, and ``period`` s the time until the next one.
    """
    angle = np.arange(16) * np.pi / 8
    targets = BACK_OFF_M * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    target = targets[int(np.argmax(surroundings.gaps(targets[:, None, :], np.zeros(1))[:, 0]))]
    selected = select_motion(velocity, target, surroundings, robot)
    action = turn_to_lookahead(
        velocity,
        selected.action,
        target,
        robot,
        may_turn=surroundings.may_turn,
        forward=surroundings.forward,
        period=period,
    )
    return replace(selected, action=action)
