"""`presage goal --cancel` and Ctrl-C of `presage explore`, with a controller that hardly answers."""

from __future__ import annotations

import io
import threading
from types import SimpleNamespace

import pytest
from rich.console import Console

from common.bus.inbox import Inbox
from common.messages.definitions import Exploration, Goal, Pose, Status
from common.messages.topics import GOAL, STATUS
from presage.live import commands, exploring
from presage.live.latest_messages import LatestMessages

CANCEL = Goal(stamp_ns=0, seq=7, pose=Pose(x=0.0, y=0.0), cancel=True)


@pytest.fixture
def goals(bus):
    """The goals that arrive."""
    inbox = Inbox()
    bus.subscribe(GOAL, inbox, keep_all=True)
    return inbox


@pytest.mark.parametrize(
    ("answers", "exit_status", "output"),
    [(True, 0, "cancelled; the robot stops\n"), (False, 1, "sent, but not confirmed by the controller\n")],
)
def test_goal_cancelled_without_statuses(bus, link, goals, monkeypatch, answers, exit_status, output):
    """A controller without beliefs publishes no status before the goal comes."""
    monkeypatch.setattr(commands, "STATUS_WARNING_S", 0.1)
    console, received = Console(file=io.StringIO(), width=150), []

    def answer():
        received.append(Goal.decode(goals.get(60).payload))
        if answers:
            bus.put(STATUS, Status(stamp_ns=0, state="idle").encode())

    controller = threading.Thread(target=answer)
    controller.start()
    assert commands.send_goal(link, CANCEL, console, wait=False) == exit_status
    controller.join()
    assert received == [CANCEL]
    assert console.file.getvalue() == output


def test_progress_of_an_exploration():
    statuses = [
        Status(
            stamp_ns=1, state=state, reason=reason,
            exploration=Exploration(phase=phase, seq=7, area=40.0, path=0.0),
        )
        for state, reason, phase in (
            ("exploring", "driving to a viewpoint", "exploring"),
            ("exploring", "returning to the start", "finished"),
        )
    ]  # fmt: skip
    messages = SimpleNamespace(wait_for=lambda *_: statuses.pop(0))
    console = Console(file=io.StringIO(), width=150)
    assert exploring._follow(messages, 7, console) == 0
    assert console.file.getvalue().startswith("exploring: 40 m² mapped, 0.0 m driven; driving to a viewpoint\n")


def test_exploration_that_may_go_on(bus, link, goals, monkeypatch):
    """What is printed after Ctrl-C does not claim more than the controller confirms."""
    monkeypatch.setattr(exploring, "_follow", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    monkeypatch.setattr(LatestMessages, "wait_for", lambda *_: None)
    console = Console(file=io.StringIO(), width=150)
    with pytest.raises(KeyboardInterrupt):
        exploring.explore(link, console)
    assert "not confirmed by the controller: the robot may still drive" in console.file.getvalue()
    assert [Goal.decode(goals.get(60).payload).cancel for _ in range(2)] == [False, True]
