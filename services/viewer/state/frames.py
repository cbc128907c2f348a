"""One frame for the page as bytes.

Layout: uint32 little-endian N, N bytes of JSON (padded with spaces so that 4 + N is a multiple of 4), then the arrays,
little-endian float32, one after another. The header's ``arrays`` gives [offset, count] of each, in floats after it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from common.messages.definitions import Belief, CmdVel, Goal, Odom, Plan, Pose, Prediction, Scan, Status, Truth, Twist

Json = dict[str, Any]
COMPACT = (",", ":")


def encode(header: Json, arrays: Mapping[str, npt.NDArray[np.float32]]) -> bytes:
    """The frame; the header gets ``arrays``. A number that JSON does not have raises ValueError."""
    places, offset = {}, 0
    for name, array in arrays.items():
        places[name] = [offset, len(array)]
        offset += len(array)
    text = json.dumps({**header, "arrays": places}, separators=COMPACT, allow_nan=False).encode()
    text += b" " * (-(4 + len(text)) % 4)
    parts = [struct.pack("<I", len(text)), text]
    return b"".join([*parts, *(np.asarray(array, "<f4").tobytes() for array in arrays.values())])


def arrays_of(
    scan: Scan, prediction: Prediction | None, plan: Plan | None, truth: Truth | None
) -> dict[str, npt.NDArray[np.float32]]:
    """Measured ranges, expected ranges and their stated sigma, m; points in map as x, y, x, y, ..., m; empty: none."""
    none = np.zeros(0, np.float32)
    return {
        "ranges": scan.ranges,
        "predicted": prediction.ranges if prediction is not None else none,
        "sigma": prediction.sigma if prediction is not None else none,
        "path": plan.path.ravel() if plan is not None else none,
        "motion": plan.motion.ravel() if plan is not None else none,
        "obstacles": plan.obstacles.ravel() if plan is not None else none,
        "people": truth.people.ravel() if truth is not None else none,
    }


def pose_of(pose: Pose) -> Json:
    """Place in m, yaw in rad."""
    return {"x": pose.x, "y": pose.y, "yaw": pose.yaw}


def twist_of(twist: Twist) -> Json:
    """Velocity in m/s, turn in rad/s."""
    return {"vx": twist.vx, "vy": twist.vy, "wz": twist.wz}


def truth_of(truth: Truth | None) -> Json | None:
    """Pose in map, and what happens to the body."""
    if truth is None:
        return None
    return {**pose_of(truth.pose), "contact": truth.contact, "stopped": truth.stopped}


def odom_of(odom: Odom | None) -> Json | None:
    """Pose in odom and velocity in base_link."""
    return None if odom is None else {**pose_of(odom.pose), **twist_of(odom.twist)}


def cmd_of(command: CmdVel | None) -> Json | None:
    """The velocity commanded."""
    return None if command is None else twist_of(command.twist)


def belief_of(belief: Belief | None) -> Json | None:
    """The posterior; ``cov`` is (3, 3) of x, y, yaw, row by row."""
    if belief is None:
        return None
    return {
        "state": belief.state,
        "stamp_ns": belief.stamp_ns,
        **pose_of(belief.pose),
        "cov": _flat(belief.covariance),
        "free_energy": belief.free_energy,
        "accuracy": belief.accuracy,
        "complexity": belief.complexity,
        "hypotheses": [
            {**pose_of(h.pose), "weight": h.weight, "cov": _flat(h.covariance)} for h in belief.hypotheses
        ],
        "estimator": belief.estimator,
    }  # fmt: skip


def status_of(status: Status | None, goals: Mapping[int, Goal]) -> Json | None:
    """What the controller does, and why; what is asked of the goal where it is one of ``goals``, by number."""
    if status is None:
        return None
    goal: Json | None = pose_of(status.goal) if status.goal is not None else None
    asked = goals.get(status.goal_seq)
    if goal is not None and asked is not None and asked.pose == status.goal:
        goal |= {"tolerance": asked.tolerance, "yaw_tolerance": asked.yaw_tolerance}
    return {"state": status.state, "reason": status.reason[:500], "distance": status.distance, "goal": goal}


def scan_of(scan: Scan) -> Json:
    """The scan's geometry."""
    return {
        "angle_min": scan.angle_min,
        "angle_increment": scan.angle_increment,
        "range_max": scan.range_max,
        "mount": pose_of(scan.mount),
    }


def _flat(matrix: npt.NDArray[np.float64] | None) -> list[float] | None:
    return None if matrix is None else [float(value) for value in matrix.ravel()]
