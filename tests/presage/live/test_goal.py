"""`presage goal`: when it fails, how long it waits, and what it says."""

from __future__ import annotations

import io
import threading
from contextlib import nullcontext

import pytest
from rich.console import Console

from common.bus.inbox import Inbox
from common.errors import UserError
from common.messages.definitions import Belief, Goal, Pose, Status
from common.messages.topics import GOAL, STATUS
from presage.live.commands import _follow, send_goal


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


class Script:
    """The messages of a controller and an estimator, in place of those on the bus; then none come."""

    def __init__(self, *steps) -> None:
        self.steps, self.latest = iter(steps), {}

    def wait_for(self, *_):
        status, self.latest["belief"] = next(self.steps, (None, None))
        return status


def step(k: int, state="navigating", *, x=0.0, distance=9.0, **fields):
    """Status and belief, 5 s after those of the step before."""
    stamp = k * 5_000_000_000
    status = Status(stamp_ns=stamp, state=state, goal_seq=7, goal=Pose(x=1.0, y=2.0), distance=distance)
    belief = Belief(stamp_ns=stamp, state=fields.pop("belief", "tracking"), pose=Pose(x=x, y=0.0))
    return status.model_copy(update=fields), belief


def follow(*steps) -> tuple[int, str]:
    goal, console = Goal(stamp_ns=0, seq=7, pose=Pose(x=1.0, y=2.0)), Console(file=io.StringIO())
    return _follow(Script(*steps), goal, console), console.file.getvalue().splitlines()[-1]


@pytest.mark.parametrize(
    "steps",
    [
        [step(k, "blocked" if k % 2 else "navigating", x=0.3 * (k % 2), reason="a door") for k in range(9)],
        [step(k, reason="a door") for k in range(9)],
        *(
            [step(k, "lost", x=2.0 * k, belief=state, distance=None, reason="a door") for k in range(9)]
            for state in ("lost", "ambiguous", "localising")
        ),
    ],
    ids=["back and forth", "standing", "lost", "ambiguous", "localising"],
)
def test_no_progress(steps):
    status, last = follow(*steps)
    assert status == 1
    assert last.endswith(": a door; no progress for 30 s: the robot keeps its goal; `presage goal --cancel` stops it")


@pytest.mark.parametrize(
    "fields",
    [lambda k: {"x": 0.3 * k}, lambda k: {"distance": 9 - 0.1 * k}, lambda _: {"distance": None}],
    ids=["a way around", "slowly", "in a lift"],
)
def test_progress(fields):
    """For 50 s, the robot drives without approaching the goal, or approaches it by 2 cm/s, or waits in a lift."""
    assert follow(*(step(k, **fields(k)) for k in range(10)), step(10, "reached")) == (0, "reached")


@pytest.mark.parametrize(
    ("steps", "says"),
    [
        ([step(0)], "no status for 30 s; the robot keeps its goal; `presage goal --cancel` stops it"),
        ([step(0), step(1, "idle", goal=None, goal_seq=0)], "was cancelled, or the controller was restarted"),
        ([step(0), step(1, goal_seq=8)], "was replaced by another"),
    ],
)
def test_end_without_arrival(steps, says):
    with pytest.raises(UserError, match=says):
        follow(*steps)
