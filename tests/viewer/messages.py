"""Synthetic messages of a robot for one stamp."""

from __future__ import annotations

import numpy as np

from common.messages.definitions import (
    Belief,
    BeliefHypothesis,
    CmdVel,
    Odom,
    Plan,
    Pose,
    Prediction,
    Preference,
    Scan,
    Status,
    Truth,
    Twist,
)
from common.messages.topics import BELIEF, CMD_VEL, ODOM, PLAN, PREDICTION, SCAN, STATUS, TRUTH

SECOND = 1_000_000_000
PEOPLE = np.array([[5, 6], [7, 8]], np.float32)
PATH = np.array([[1.5, 2], [3, 2.5], [9, 2]], np.float32)
MOTION = np.array([[1.5, 2], [1.75, 2]], np.float32)
UNMAPPED = np.array([[4, 2.25]], np.float32)
RANGES = np.array([1.5, np.inf, -np.inf, 4.0, 25.0], np.float32)


def at(stamp_s: float, x: float = 1.0, error: float = 0.5) -> dict:
    """Messages by topic, in the order in which they are published."""
    stamp = round(stamp_s * SECOND)
    covariance = np.diag([0.01, 0.04, 0.09])
    pose, twist = Pose(x=x, y=2.0, yaw=0.25), Twist(vx=0.3, vy=0.4)
    believed = Pose(x=x + error, y=2.0, yaw=0.25)
    return {
        ODOM: Odom(stamp_ns=stamp, pose=pose, twist=twist, covariance=covariance),
        TRUTH: Truth(stamp_ns=stamp, pose=pose, twist=twist, contact=True, people=PEOPLE),
        SCAN: Scan(
            stamp_ns=stamp, angle_min=-1.0, angle_increment=0.5, range_min=0.05, range_max=25.0, ranges=RANGES,
            mount=Pose(x=0.2, y=0.0),
        ),
        BELIEF: Belief(
            stamp_ns=stamp, state="tracking", pose=believed, covariance=covariance, xi=np.zeros(3, np.float32),
            free_energy=12.0, accuracy=10.0, complexity=2.0, estimator="precise",
            probability=0.75, protection=np.array([0.5, 0.25, 0.125]),
            hypotheses=[BeliefHypothesis(pose=believed, covariance=covariance, weight=0.75)],
        ),
        PREDICTION: Prediction(
            stamp_ns=stamp, angle_min=-1.0, angle_increment=0.5, ranges=np.arange(5, dtype=np.float32),
            sigma=np.full(5, 0.1, np.float32),
        ),
        STATUS: Status(stamp_ns=stamp, state="navigating", goal=Pose(x=9.0, y=2.0), distance=8.0),
        CMD_VEL: CmdVel(stamp_ns=stamp, twist=Twist(vx=0.3, vy=0.4)),
        PLAN: Plan(stamp_ns=stamp, path=PATH, motion=MOTION, obstacles=UNMAPPED),
    }  # fmt: skip


def preference(stamp_s: float, x: float = 9.0, width: int = 3, height: int = 2) -> Preference:
    """A goal field of distances to (x, 2). The last cell is unreachable."""
    distance = np.append(np.arange(width * height - 1, dtype=np.float32), np.float32(np.inf))
    return Preference(
        stamp_ns=round(stamp_s * SECOND), goal=Pose(x=x, y=2.0), origin=Pose(x=-1.0, y=-2.0), resolution=0.5,
        width=width, height=height, distance=distance,
    )  # fmt: skip
