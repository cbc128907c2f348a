"""Encodes the frames that the page shows.

Layout: N as a little-endian uint32, then N bytes of JSON (padded with spaces so that 4 + N is a multiple of 4), then
the arrays one after another, as little-endian float32. The header's field ``arrays`` gives [offset, count] of each
array, counted in floats from the end of the header.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from common.geometry.world import World
from common.messages.definitions import (
    Belief,
    CmdVel,
    Goal,
    Map,
    Odom,
    Plan,
    Pose,
    Prediction,
    Scan,
    Status,
    Truth,
    Twist,
)

Json = dict[str, Any]
COMPACT = (",", ":")


def encode_frame(header: Json, arrays: Mapping[str, npt.NDArray[np.float32]]) -> bytes:
    """Encodes a frame, and adds ``arrays`` to the header. Raises ValueError if the header has a non-finite number."""
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
    """Arrays of a frame, in m: measured and predicted ranges and their sigma, and points in map as x, y, x, y, ...

    The array of a missing message is empty.
    """
    empty = np.zeros(0, np.float32)
    return {
        "ranges": scan.ranges,
        "predicted": prediction.ranges if prediction is not None else empty,
        "sigma": prediction.sigma if prediction is not None else empty,
        "path": plan.path.ravel() if plan is not None else empty,
        "motion": plan.motion.ravel() if plan is not None else empty,
        "obstacles": plan.obstacles.ravel() if plan is not None else empty,
        "people": truth.people.ravel() if truth is not None else empty,
    }


def pose_as_json(pose: Pose) -> Json:
    """Position in m and yaw in rad."""
    return {"x": pose.x, "y": pose.y, "yaw": pose.yaw}


def twist_as_json(twist: Twist) -> Json:
    """Velocity in m/s and turn rate in rad/s."""
    return {"vx": twist.vx, "vy": twist.vy, "wz": twist.wz}


def truth_as_json(truth: Truth | None) -> Json | None:
    """True pose in map, and whether the robot touches something or is held by the obstacle stop."""
    if truth is None:
        return None
    return {**pose_as_json(truth.pose), "contact": truth.contact, "stopped": truth.stopped}


def odom_as_json(odom: Odom | None) -> Json | None:
    """Pose in odom, and velocity in base_link."""
    return None if odom is None else {**pose_as_json(odom.pose), **twist_as_json(odom.twist)}


def cmd_as_json(command: CmdVel | None) -> Json | None:
    """Commanded velocity."""
    return None if command is None else twist_as_json(command.twist)


def belief_as_json(belief: Belief | None) -> Json | None:
    """Belief with its hypotheses. ``cov`` is the (3, 3) covariance of x, y, yaw, row by row."""
    if belief is None:
        return None
    return {
        "state": belief.state,
        "stamp_ns": belief.stamp_ns,
        **pose_as_json(belief.pose),
        "cov": _flat(belief.covariance),
        "free_energy": belief.free_energy,
        "accuracy": belief.accuracy,
        "complexity": belief.complexity,
        "probability": belief.probability,
        "protection": None if belief.protection is None else belief.protection.tolist(),
        "hypotheses": [
            {**pose_as_json(h.pose), "weight": h.weight, "cov": _flat(h.covariance)} for h in belief.hypotheses
        ],
        "estimator": belief.estimator,
        "field_version": belief.field_version,
    }


def status_as_json(status: Status | None, goals: Mapping[int, Goal]) -> Json | None:
    """The controller's status. Includes the goal's tolerances if the goal is one of ``goals`` (by sequence number)."""
    if status is None:
        return None
    goal: Json | None = pose_as_json(status.goal) if status.goal is not None else None
    message = goals.get(status.goal_seq)
    if goal is not None and message is not None and (message.map_id or message.pose == status.goal):
        goal |= {"tolerance": message.tolerance, "yaw_tolerance": message.yaw_tolerance}
    energy = None if status.energy is None else status.energy.model_dump()
    exploration = None if status.exploration is None else status.exploration.model_dump(exclude={"seq"})
    return {
        "state": status.state,
        "reason": status.reason[:500],
        "distance": status.distance,
        "goal": goal,
        "energy": energy,
        "exploration": exploration,
    }


def map_as_json(message: Map, robot: str) -> str:
    """A map as a message of type ``map``: a world, the path of the key scans, and the ends of loop closures, in m."""
    world = World.model_validate({"name": "map", "grid": message.grid})
    parts = {
        "type": "map",
        "robot": robot,
        "world": world.model_dump(mode="json"),
        "path": message.poses[:, :2].round(3).tolist(),
        "closures": message.closures.astype(float).round(3).reshape(-1, 2, 2).tolist(),
    }
    return json.dumps(parts, separators=COMPACT)


def scan_as_json(scan: Scan) -> Json:
    """Beam angles, maximum range and mount of a scan."""
    return {
        "angle_min": scan.angle_min,
        "angle_increment": scan.angle_increment,
        "range_max": scan.range_max,
        "mount": pose_as_json(scan.mount),
    }


def _flat(matrix: npt.NDArray[np.float64] | None) -> list[float] | None:
    return None if matrix is None else [float(value) for value in matrix.ravel()]
