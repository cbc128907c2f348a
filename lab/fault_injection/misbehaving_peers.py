"""Participants that flood, repeat or stall."""

from __future__ import annotations

import os
import threading
import time

import numpy as np

from common.bus.bus import Bus, Link, open_bus
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.messages.topics import BELIEF, CMD_VEL, SCAN, TOPICS

REPEAT_DELAY_S = 1.0
PROCESSING_TIME_S = 0.2  # per message


def main(arguments: list[str]) -> None:
    """Runs one kind of misbehaviour until killed: "repeater", "slow subscriber", or "malformed" with a count."""
    what, *rest = arguments
    robot, connect = os.environ["PRESAGE_ROBOT"], os.environ["PRESAGE_CONNECT"]
    listen = os.environ.get("PRESAGE_LISTEN") or "tcp/127.0.0.1:0"
    with open_bus(Link(robot=robot, connect=(connect,), listen=(listen,), insecure=True)) as bus:
        if what == "repeater":
            repeat(bus)
        elif what == "slow subscriber":
            listen_slowly(bus)
        elif what == "malformed":
            send_noise(bus, int(rest[0]))
        else:
            raise UserError(f"unknown misbehaviour {what!r}")


def repeat(bus: Bus) -> None:
    """Repeats every received message at once and again after a delay, except its own repetitions."""
    inbox, late = Inbox(), []
    for topic in (SCAN, BELIEF, CMD_VEL):
        bus.subscribe(topic, inbox, keep_all=True)
    while True:
        sample = inbox.get(0.01)
        now = time.monotonic()
        if isinstance(sample, Sample) and sample.source != bus.zid:
            bus.put(sample.topic, sample.payload)
            late.append((now + REPEAT_DELAY_S, sample))
        while late and late[0][0] <= now:
            _, old = late.pop(0)
            bus.put(old.topic, old.payload)


def listen_slowly(bus: Bus) -> None:
    """Subscribes to all topics and blocks zenoh's callback thread for each message, as a badly written peer might."""

    class Slow(Inbox):
        def put(self, entry: object, *, newest_only: bool = False) -> None:  # noqa: ARG002
            time.sleep(PROCESSING_TIME_S)

    slow = Slow()
    for topic in TOPICS:
        bus.subscribe(topic, slow, keep_all=True)
    threading.Event().wait()


def send_noise(bus: Bus, count: int) -> None:
    """Sends ``count`` random payloads, on all topics in turn."""
    rng = np.random.default_rng(0)
    payloads = [rng.bytes(int(size)) for size in rng.integers(0, 600, 997)]
    for topic in TOPICS:
        bus.wait_matching(topic, 5)
    for number in range(count):
        bus.put(TOPICS[number % len(TOPICS)], payloads[number % len(payloads)], "chaos")
    print(f"sent {count}", flush=True)
    threading.Event().wait()
