"""A minimal service, run as a process by test_service."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, ClassVar

from pydantic import Field

from common.errors import UserError
from common.messages.definitions import CmdVel, Goal, Pose, Scan
from common.messages.requests import PoseRequest, Reply
from common.messages.topics import CMD_VEL, GOAL, HEALTH, PREDICT, SCAN, TELEPORT
from common.runtime.config import ServiceSettings
from common.runtime.service import Service, main


class SmallSettings(ServiceSettings):
    """A small service."""

    service: ClassVar[str] = "small"
    fail: Annotated[str, Field(description="where to raise an error")] = ""
    slow: Annotated[str, Field(description="where to be slow")] = ""


class Small(Service):
    """Publishes a command for each scan, and fails as the data of the messages request it."""

    name = "small"
    inputs = (SCAN, GOAL, HEALTH)
    queries = (TELEPORT,)

    def __init__(self, settings):
        super().__init__(settings)
        self.fail = settings.fail
        self.pool = ThreadPoolExecutor(1)
        if settings.slow == "making":
            self.log.info("in the making")
            time.sleep(0.5)

    def open(self):
        if self.fail == "open":
            raise UserError("no weights in that folder; train some")
        if self.settings.slow == "opening":
            self.log.info("opening")
            time.sleep(0.5)

    def on_message(self, topic, message):
        if isinstance(message, Scan):
            self.counters["scans"] += 1
            self.publish(CMD_VEL, CmdVel(stamp_ns=message.stamp_ns, twist={"vx": 0.5}))
        elif isinstance(message, Goal) and message.cancel:
            # Sent to itself: a blocking request would never return.
            self.send_request(
                TELEPORT if message.pose.y == 0 else PREDICT,
                PoseRequest(pose=message.pose),
                timeout=10.0 if message.pose.x != 1.0 else 1.0,
            )
        elif isinstance(message, Goal) and message.pose.x < 0:
            raise ValueError("a bug in on_message")
        elif isinstance(message, Goal) and message.pose.x > 100:
            raise UserError("the map ends before that")
        elif isinstance(message, Goal):
            time.sleep(message.pose.x)

    def on_request(self, query, request):
        if request.pose.x < 0:
            raise UserError("inside a wall")
        if request.pose.x > 100:
            raise ValueError("a bug in on_request")
        if request.pose.y == 2:  # another thread does the work
            return self.pool.submit(self.slow_reply, request)
        return Reply(reason=f"at {request.pose.x:g}")

    def slow_reply(self, request):
        time.sleep(0.5)
        if request.pose.x == 50:
            raise UserError("inside a wall of the other thread")
        return Reply(reason=f"late at {request.pose.x:g}")

    def on_reply(self, query, number, reply):
        self.counters["replies"] += 1
        self.note = f"{number} {query.name} {reply.ok} {reply.reason}"

    def due(self):
        return None if self.fail != "timer" else 0.05

    def on_timer(self):
        raise ValueError("never due")

    def close(self):
        self.log.info("closed", origin=Pose(x=0.0, y=0.0).array().tolist())


if __name__ == "__main__":
    main(SmallSettings, Small)
