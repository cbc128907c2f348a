"""Prints bus traffic at the robot's host as JSON lines.

The clock is the machine's monotonic one, which all processes share: intervals between processes can be told.
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

SEEN = (TRUTH, STATUS, BELIEF, CMD_VEL, HEALTH, SCAN)


def told(message: Message) -> dict[str, Any]:
    """What matters of a message."""
    if isinstance(message, Truth):
        speed = float(np.hypot(message.twist.vx, message.twist.vy))
        place = [message.pose.x, message.pose.y]
        return {"what": "truth", "speed": speed, "stamp": message.stamp_ns, "contact": message.contact, "place": place}
    if isinstance(message, Status):
        return {
            "what": "status", "state": message.state, "reason": message.reason, "goal_seq": message.goal_seq,
            "distance": message.distance,
        }  # fmt: skip
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
    """Until told to end."""
    connect, robot = os.environ["PRESAGE_CONNECT"], os.environ["PRESAGE_ROBOT"]
    listen = os.environ.get("PRESAGE_LISTEN") or "tcp/127.0.0.1:0"
    inbox = Inbox()

    alone = threading.Lock()  # zenoh's threads say things too

    def say(**row: Any) -> None:
        with alone:
            print(json.dumps({"t": time.monotonic(), **row}), flush=True)

    with open_bus(Link(robot=robot, connect=(connect,), listen=(listen,), lossless=False, insecure=True)) as bus:
        bus.watch_alive(lambda service, there: say(what="alive", service=service, there=there))
        for topic in SEEN:
            bus.subscribe(topic, inbox, keep_all=True)
        say(what="ready")
        while True:
            sample = inbox.get(60)
            if isinstance(sample, Sample):
                try:
                    say(**told(sample.topic.message.decode(sample.payload)), source=sample.source)
                except DecodeError:
                    say(what="undecodable", key=sample.key)


if __name__ == "__main__":
    try:
        main()
    except (UserError, KeyboardInterrupt) as error:
        sys.exit(f"observer: {error}")
