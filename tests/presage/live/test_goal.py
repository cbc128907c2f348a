"""`presage goal` fails if the controller refuses the goal, but not if an obstacle is in the way at first."""

from __future__ import annotations

import io
import threading
from contextlib import nullcontext

import pytest
from rich.console import Console

from common.bus.inbox import Inbox
from common.errors import UserError
from common.messages.definitions import Goal, Pose, Status
from common.messages.topics import GOAL, STATUS
from presage.live.commands import send_goal


@pytest.mark.parametrize(
    ("refused", "outcome"), [(False, nullcontext()), (True, pytest.raises(UserError, match="the reason"))]
)
def test_blocked_at_first(bus, link, refused, outcome):
    goal, goals, console = Goal(stamp_ns=0, seq=7, pose=Pose(x=1.0, y=2.0)), Inbox(), Console(file=io.StringIO())
    bus.subscribe(GOAL, goals, keep_all=True)
    ended = threading.Event()

    def answer():
        seq = 0
        while not ended.is_set():
            seq = 7 if goals.get(0.02) is not None else seq
            bus.put(
                STATUS, Status(stamp_ns=0, state="blocked", reason="the reason", refused=refused, goal_seq=seq).encode()
            )

    controller = threading.Thread(target=answer)
    controller.start()
    try:
        with outcome:
            assert send_goal(link, goal, console, wait=False) == 0
            assert console.file.getvalue() == "going to (1, 2)\n"
    finally:
        ended.set()
        controller.join()
