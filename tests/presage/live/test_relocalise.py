"""`presage relocalise`: the state and pose that it prints."""

from __future__ import annotations

import io
import threading

import pytest
from rich.console import Console

from common.bus.inbox import Inbox
from common.errors import UserError
from common.messages.definitions import Belief, Pose
from common.messages.requests import Reply
from common.messages.topics import BELIEF, LOCALISE
from presage.live import commands


@pytest.mark.parametrize(
    ("states", "status", "last_line"),
    [
        (["localising", "tracking"], 0, "tracking at (3.000, -1.500), 90.0 deg in the map"),
        (["localising", "ambiguous"], 1, "ambiguous after 1 s, most probably at (3.000, -1.500), 90.0 deg in the map"),
    ],
)
def test_result(bus, link, monkeypatch, states, status, last_line):
    monkeypatch.setattr(commands, "LOCALISATION_TIMEOUT_S", 1.0)
    requests, console = Inbox(), Console(file=io.StringIO(), width=150)
    bus.serve(LOCALISE, requests)

    def answer():
        requests.get(10).reply(Reply().encode())
        assert bus.wait_matching(BELIEF, 10)
        for stamp, state in enumerate(states):
            bus.put(BELIEF, Belief(stamp_ns=stamp, state=state, pose=Pose(x=3.0, y=-1.5, yaw=1.5708)).encode())

    estimator = threading.Thread(target=answer)
    estimator.start()
    assert commands.relocalise(link, None, console) == status
    estimator.join()
    assert console.file.getvalue().splitlines()[-1] == last_line


def test_heading_that_is_not_used(bus, link):
    """Preset paper keeps the heading for which it was trained."""
    requests, console = Inbox(), Console(file=io.StringIO(), width=150)
    bus.serve(LOCALISE, requests)

    def answer():
        requests.get(10).reply(Reply().encode())
        assert bus.wait_matching(BELIEF, 10)
        found = Belief(stamp_ns=0, state="tracking", pose=Pose(x=3.0, y=1.5, yaw=1.5708), estimator="paper")
        bus.put(BELIEF, found.encode())

    estimator = threading.Thread(target=answer)
    estimator.start()
    assert commands.relocalise(link, Pose(x=3.0, y=1.5, yaw=0.0), console) == 0
    estimator.join()
    assert console.file.getvalue().splitlines()[1:] == [
        "tracking at (3.000, 1.500), 90.0 deg in the map",
        "preset paper knows only this heading; the 0 deg given were not used",
    ]


def test_no_belief(bus, link, monkeypatch):
    monkeypatch.setattr(commands, "LOCALISATION_TIMEOUT_S", 0.1)
    requests = Inbox()
    bus.serve(LOCALISE, requests)
    estimator = threading.Thread(target=lambda: requests.get(10).reply(Reply().encode()))
    estimator.start()
    with pytest.raises(UserError, match="no belief came within"):
        commands.relocalise(link, None, Console(file=io.StringIO()))
    estimator.join()
