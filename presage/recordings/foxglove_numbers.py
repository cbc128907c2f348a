"""Foxglove's channels of plain numbers, for its plots; their JSON schemas state the units."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.geometry.se2 import Array, between
from common.messages.definitions import Belief, CmdVel, Drive, Health, Status, Truth

# By channel and field: JSON type and meaning. Messages leave out fields whose value is unknown.
FIELDS: dict[str, dict[str, tuple[str, str]]] = {
    "/belief/numbers": {
        "stamp_s": ("number", "s, the scan's own stamp"),
        "state": ("string", "localising, tracking, ambiguous or lost"),
        "free_energy": ("number", "nats, accuracy + complexity"),
        "accuracy": ("number", "nats, -ln p(o | pose)"),
        "complexity": ("number", "nats"),
        "hypotheses": ("integer", "Gaussians in the mixture"),
        "weight": ("number", "of the best hypothesis"),
        "sigma_x": ("number", "m"),
        "sigma_y": ("number", "m"),
        "sigma_yaw": ("number", "rad"),
        "probability": ("number", "that the pose is within 0.2 m and 5 degrees of the truth"),
        "protection_x": ("number", "m along base_link, an error exceeded in one of 10^4 scans"),
        "protection_y": ("number", "m across base_link"),
        "protection_yaw": ("number", "rad"),
    },
    "/error": {
        "stamp_s": ("number", "s"),
        "position": ("number", "m, from the belief to the truth of the same stamp"),
        "heading": ("number", "rad, absolute"),
        "goal_distance": ("number", "m, from the truth to the goal"),
    },
    "/truth/numbers": {
        "stamp_s": ("number", "s"),
        "vx": ("number", "m/s, base_link"),
        "vy": ("number", "m/s, base_link"),
        "wz": ("number", "rad/s"),
        "contact": ("boolean", "the body touches something"),
        "stopped": ("boolean", "the obstacle stop holds the wheels back"),
    },
    "/cmd_vel": {
        "stamp_s": ("number", "s, of the scan it answers"),
        "vx": ("number", "m/s, base_link"),
        "vy": ("number", "m/s, base_link"),
        "wz": ("number", "rad/s"),
    },
    "/drive": {
        "stamp_s": ("number", "s"),
        "vx": ("number", "m/s, base_link"),
        "vy": ("number", "m/s, base_link"),
        "wz": ("number", "rad/s"),
    },
    "/status": {
        "stamp_s": ("number", "s"),
        "state": ("string", "idle, navigating, reached, blocked or lost"),
        "reason": ("string", ""),
        "distance": ("number", "m, from the believed pose to the goal"),
    },
}
HEALTH: dict[str, Any] = {
    "type": "object",
    "properties": {
        "service": {"type": "string"},
        "uptime": {"type": "number", "description": "s, wall time"},
        "note": {"type": "string"},
        "topics": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "key": {"type": "string"},
                    **{name: {"type": "integer"} for name in ("received", "published", "dropped", "undecodable")},
                    "rate": {"type": "number", "description": "Hz over the last second"},
                },
            },
        },
        "counters": {
            "type": "array",
            "items": {"type": "object", "properties": {"name": {"type": "string"}, "value": {"type": "integer"}}},
        },
    },
}


def schema_of(topic: str) -> tuple[str, dict[str, Any]]:
    """Name and JSON schema of a channel."""
    if topic.startswith("/health/"):
        return "presage.Health", HEALTH
    properties = {name: {"type": kind, "description": about} for name, (kind, about) in FIELDS[topic].items()}
    name = "presage." + "".join(part.capitalize() for part in topic.replace("_", "/").split("/"))
    return name, {"type": "object", "properties": properties}


def _known(values: dict[str, Any]) -> dict[str, Any]:
    """Removes values that are None or not finite, which JSON cannot represent."""
    return {k: v for k, v in values.items() if v is not None and not (isinstance(v, float) and not np.isfinite(v))}


def of_belief(belief: Belief) -> dict[str, Any]:
    """State, free energy and uncertainty of a belief."""
    spread = [None, None, None] if belief.covariance is None else np.sqrt(np.diag(belief.covariance)).tolist()
    protection = [None, None, None] if belief.protection is None else belief.protection.tolist()
    weights = [hypothesis.weight for hypothesis in belief.hypotheses]
    return _known(
        {
            "stamp_s": belief.stamp_ns * 1e-9,
            "state": belief.state,
            "free_energy": belief.free_energy,
            "accuracy": belief.accuracy,
            "complexity": belief.complexity,
            "hypotheses": len(weights),
            "weight": max(weights, default=None),
            **dict(zip(("sigma_x", "sigma_y", "sigma_yaw"), spread, strict=True)),
            "probability": belief.probability,
            **dict(zip(("protection_x", "protection_y", "protection_yaw"), protection, strict=True)),
        }
    )


def of_error(belief: Belief, truth: Array, goal: Array | None) -> dict[str, Any]:
    """Errors of a belief against the true pose (3,), and the distance from that to the goal (3,), in map."""
    difference = between(truth, belief.pose.array())
    return _known(
        {
            "stamp_s": belief.stamp_ns * 1e-9,
            "position": float(np.hypot(difference[0], difference[1])),
            "heading": float(abs(difference[2])),
            "goal_distance": None if goal is None else float(np.hypot(*(goal - truth)[:2])),
        }
    )


def of_truth(truth: Truth) -> dict[str, Any]:
    """True velocity, contact and obstacle stop."""
    return {**_twist(truth), "contact": truth.contact, "stopped": truth.stopped}


def of_command(command: CmdVel | Drive) -> dict[str, Any]:
    """Commanded velocity."""
    return _twist(command)


def _twist(message: Truth | CmdVel | Drive) -> dict[str, Any]:
    twist = message.twist
    return {"stamp_s": message.stamp_ns * 1e-9, "vx": twist.vx, "vy": twist.vy, "wz": twist.wz}


def of_status(status: Status) -> dict[str, Any]:
    """State of the controller."""
    return _known(
        {
            "stamp_s": status.stamp_ns * 1e-9,
            "state": status.state,
            "reason": status.reason,
            "distance": status.distance,
        }
    )


def of_health(health: Health) -> dict[str, Any]:
    """Health of a service with its counters."""
    names = HEALTH["properties"]["topics"]["items"]["properties"]
    return {
        "service": health.service,
        "uptime": health.uptime,
        "note": health.note,
        "topics": [{name: getattr(row, name) for name in names} for row in health.topics],
        "counters": [{"name": name, "value": value} for name, value in health.counters.items()],
    }
