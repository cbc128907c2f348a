"""Prints bus traffic at the robot's host as JSON lines.

Times are of the machine's monotonic clock, which all processes share, so that intervals between processes are exact.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from typing import Any

import numpy as np

from common.bus.bus import Link, open_bus
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.definitions import Belief, CmdVel, Health, Scan, Status, Truth
from common.messages.topics import BELIEF, CMD_VEL, HEALTH, SCAN, STATUS, TRUTH
from common.messages.wire import DecodeError, Message

OBSERVED_TOPICS = (TRUTH, STATUS, BELIEF, CMD_VEL, HEALTH, SCAN)


def describe(message: Message) -> dict[str, Any]:
    """The fields of a message that the benchmark evaluates."""
    if isinstance(message, Truth):
        speed = float(np.hypot(message.twist.vx, message.twist.vy))
        place = [message.pose.x, message.pose.y]
        return {"what": "truth", "speed": speed, "stamp": message.stamp_ns, "contact": message.contact, "place": place}
    if isinstance(message, Status):
        return {
            "what": "status",
            "state": message.state,
            "reason": message.reason,
            "goal_seq": message.goal_seq,
            "distance": message.distance,
        }
    if isinstance(message, Belief):
        return {
            "what": "belief",
            "stamp": message.stamp_ns,
            "state": message.state,
            "place": [message.pose.x, message.pose.y],
        }
    if isinstance(message, CmdVel):
        return {
            "what": "cmd_vel",
            "stamp": message.stamp_ns,
            "speed": float(np.hypot(message.twist.vx, message.twist.vy)),
        }
    if isinstance(message, Health):
        return {"what": "health", "service": message.service, "counters": message.counters, "note": message.note}
    if isinstance(message, Scan):
        return {"what": "scan", "seq": message.seq, "stamp": message.stamp_ns}
    raise TypeError(type(message).__name__)


def main() -> None:
    """Prints events until the process is ended."""
    connect, robot = os.environ["PRESAGE_CONNECT"], os.environ["PRESAGE_ROBOT"]
    listen = os.environ.get("PRESAGE_LISTEN") or "tcp/127.0.0.1:0"
    inbox = Inbox()

    lock = threading.Lock()  # events also come from zenoh's threads

    def emit(**row: Any) -> None:
        with lock:
            print(json.dumps({"t": time.monotonic(), **row}), flush=True)

    with open_bus(Link(robot=robot, connect=(connect,), listen=(listen,), lossless=False, insecure=True)) as bus:
        bus.watch_alive(lambda service, there: emit(what="alive", service=service, there=there))
        for topic in OBSERVED_TOPICS:
            bus.subscribe(topic, inbox, keep_all=True)
        emit(what="ready")
        while True:
            sample = inbox.get(60)
            if isinstance(sample, Sample):
                try:
                    emit(**describe(sample.topic.message.decode(sample.payload)), source=sample.source)
                except DecodeError:
                    emit(what="undecodable", key=sample.key)


if __name__ == "__main__":
    try:
        main()
    except (UserError, KeyboardInterrupt) as error:
        sys.exit(f"observer: {error}")
