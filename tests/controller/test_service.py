"""When the controller answers a belief, also if scan or predictions come late."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from structlog.testing import capture_logs

from common.bus.inbox import Inbox
from common.errors import UserError
from common.geometry.occupancy_grid import FREE, OccupancyGrid
from common.messages.definitions import Map
from common.messages.requests import PredictReply, Reply
from common.messages.topics import BELIEF, CMD_VEL, GOAL, MAP, MAX_BYTES, PREDICT, SCAN, STATUS
from common.runtime.service import ServiceLoop
from services.controller import service as shell
from services.controller.policies.active_localisation import ViewpointPaths
from services.controller.service import ControllerService
from services.controller.settings import ControllerSettings
from tests.controller.driving import PERIOD_NS, belief, goal, room, scan
from tests.process_replay.harness import FakeBus

ROOM, POSE = room(10, 4), np.array([2.0, 2.0, 0.0])
PATHS = ViewpointPaths(POSE[None], np.ones(1), POSE[None], np.ones(1))


class Clock:
    now = 0.0

    def monotonic(self):
        return self.now

    def thread_time_ns(self):
        return 0


class Predicting:
    """Stands in for the policy that needs predictions, for beliefs with the given numbers."""

    def __init__(self, numbers):
        self.numbers, self.used, self.failed = numbers, 0, 0

    def prediction_request(self, message):
        return PATHS if message.stamp_ns // PERIOD_NS in self.numbers else None

    def use_predictions(self, reply):
        self.used += 1

    def fail_prediction(self, reason):
        self.failed += 1


@pytest.mark.parametrize(
    ("needs_predictions", "events", "answers"),
    [
        ((), "s0 b0 s1 b1", ". 0 . 1"),
        ((), "s0 b0 b0", ". 0 0"),  # a repeated belief is answered again
        ((), "s0 b1 s1 b1", ". . 1 1"),  # before its scan
        ((), "s0 b1 b1 s1", ". . . 1"),
        ((), "s0 b1 t", ". . 1"),  # the scan does not come
        ((), "s0 b1 b2 s2", ". . 1 2"),
        ((), "s0 b0 t s1 b1 t", ". 0 0 . 1 1"),  # no belief: stops with the latest stamp
        ((1,), "s1 b1 r1", ". . 1"),
        ((1,), "s1 b1 f1", ". . 1"),  # no predictions
        ((1,), "s1 b1 b1 r1", ". . . 1"),
        ((1,), "s1 b1 s2 b2 r1", ". . . 2 ."),  # a newer belief takes its place; the policy still gets the predictions
        ((1, 2), "s1 b1 s2 b2 r1 r2", ". . . . . 2"),  # only the latest request counts
        ((1,), "s1 b1 b2 s2", ". . 1 2"),
        ((1,), "s0 b1 s1 r1", ". . . 1"),
        ((1,), "s1 b1 t", ". . 0"),  # no reply and no newer belief
    ],
)
def test_answers(monkeypatch, needs_predictions, events, answers):
    """Events: s scan, b belief, r reply, f failed reply, each with a number; t timer, when it is due."""
    clock = Clock()
    monkeypatch.setattr(shell, "time", clock)
    service, bus = ControllerService(ControllerSettings(preset="paper", world="")), FakeBus()
    loop = ServiceLoop(service, bus, Inbox())
    service.open()
    service.navigator.on_goal(goal(8, 2))
    service.geodesic = policy = Predicting(needs_predictions)
    monkeypatch.setattr(service, "_publish_plan", lambda stamp_ns: None)
    requests = {}
    monkeypatch.setattr(loop, "send_request", lambda *_: requests.setdefault(len(requests) + 1, len(requests) + 1))
    found = []
    for event in events.split():
        kind, number = event[0], int(event[1:] or 0)
        if kind == "s":
            service.on_message(SCAN, scan(number * PERIOD_NS, POSE, ROOM))
        elif kind == "b":
            service.on_message(BELIEF, belief(number * PERIOD_NS, POSE))
        elif kind == "t":
            clock.now += service.due()
            service.on_timer()
        else:
            reply = PredictReply() if kind == "r" else Reply(ok=False, reason="busy")
            service.on_reply(PREDICT, number, reply)
        sent = [CMD_VEL.message.decode(p).stamp_ns // PERIOD_NS for topic, p in bus.sent if topic is CMD_VEL]
        bus.sent.clear()
        found.append(" ".join(map(str, sent)) or ".")
    assert " ".join(found) == answers
    assert policy.failed == events.count("f")
    assert policy.used == len([e for e in events.split() if e == f"r{max(requests, default=0)}"])


def test_a_repeated_map_is_not_planned_in_again(monkeypatch):
    service, planned = ControllerService(ControllerSettings(world="")), []
    ServiceLoop(service, FakeBus(), Inbox())
    service.open()
    monkeypatch.setattr(service, "_map_job", SimpleNamespace(submit=lambda job: planned.append(job().message)))
    grid = OccupancyGrid.of(np.full((9, 9), FREE, np.uint8), 0.05, (0.0, 0.0, 0.0))
    first = Map(stamp_ns=1, grid=grid, poses=[(0.2, 0.2, 0.0)])
    moved = first.model_copy(update={"poses": first.poses + 0.1, "stamp_ns": 3, "seq": 2})
    for message in (first, first.model_copy(update={"stamp_ns": 2, "seq": 1}), moved, first):
        service.on_message(MAP, message)
    assert planned == [first, moved, first]


def test_reason_after_a_belief_without_its_scan(monkeypatch):
    """The scanner has fallen silent, even if the last scan came to the estimator only."""
    clock = Clock()
    monkeypatch.setattr(shell, "time", clock)
    service, bus = ControllerService(ControllerSettings(world="", preset="paper")), FakeBus()
    ServiceLoop(service, bus, Inbox())
    service.open()
    service.on_message(SCAN, scan(0, POSE, ROOM))
    service.on_message(BELIEF, belief(PERIOD_NS, POSE))
    service.on_message(GOAL, goal(8, 2))
    for _ in range(2):  # the scan does not come, and no further belief
        clock.now += service.due()
        service.on_timer()
    last = [STATUS.message.decode(payload) for topic, payload in bus.sent if topic is STATUS][-1]
    assert "no scan" in last.reason


def test_goal_without_beliefs():
    service, bus = ControllerService(ControllerSettings(world="", preset="paper")), FakeBus()
    ServiceLoop(service, bus, Inbox())
    service.open()
    service.on_message(GOAL, goal(8, 2))
    (status,) = (STATUS.message.decode(payload) for topic, payload in bus.sent if topic is STATUS)
    assert (status.state, status.reason) == ("lost", "no belief: is the estimator running?")
    service.on_message(SCAN, scan(0, POSE, ROOM))
    service.on_message(BELIEF, belief(0, POSE))
    assert service.navigator.goal_state.status(0, None).state == "navigating"


def test_log_of_goals():
    """A line contains only what applies."""
    service = ControllerService(ControllerSettings(world="", preset="paper"))
    ServiceLoop(service, FakeBus(), Inbox())
    service.open()
    with capture_logs() as lines:
        for changes in ({}, {"map_id": "first"}, {"explore": True}, {"cancel": True}):
            service.on_message(GOAL, goal(8, 2).model_copy(update=changes))
    assert [{name: value for name, value in line.items() if name != "log_level"} for line in lines] == [
        {"event": "goal", "x": 8.0, "y": 2.0},
        {"event": "goal", "x": 8.0, "y": 2.0, "floor": "first"},
        {"event": "exploration requested"},
        {"event": "goal cancelled"},
    ]


@pytest.mark.parametrize("drives", [False, True])
def test_warning_without_beliefs(drives):
    """Only a robot that drives is stopped; one that stands may wait for a search of the whole map."""
    service, bus = ControllerService(ControllerSettings(world="", preset="paper")), FakeBus()
    ServiceLoop(service, bus, Inbox())
    service.open()
    if drives:
        service.navigator.on_goal(goal(8, 2))
    for number in range(3):
        service.on_message(SCAN, scan(number * PERIOD_NS, POSE, ROOM))
        service.on_message(BELIEF, belief(number * PERIOD_NS, POSE))
    with capture_logs() as lines:
        service.on_timer()
    assert [line["event"] for line in lines] == ["stopping the robot"] * drives
    assert service.counters["belief_timeouts"] == 1


@pytest.mark.parametrize(("shape", "side"), [((30, 50), 1), ((600, 901), 2), ((9001, 3), 3)])
def test_cost_field_of_a_large_building(shape, side):
    """It is published with larger cells, each with the least cost in it, so that no receiver drops it."""
    cost = np.random.default_rng(0).random(shape)
    grid = SimpleNamespace(shape=shape, origin=(1.0, 2.0), resolution=0.1)
    unknown = np.zeros(shape, bool)
    unknown[0, 0] = True
    graph = SimpleNamespace(grid=grid, free=SimpleNamespace(unknown=unknown))
    message = shell.preference_message(SimpleNamespace(graph=graph, cost=cost), goal(3.0, 4.0), 7)
    assert len(message.encode()) < MAX_BYTES
    assert message.resolution == pytest.approx(0.1 * side)
    sent = message.distance.reshape(message.height, message.width)
    cost[0, 0] = np.inf
    assert sent[0, 0] == pytest.approx(cost[:side, :side].min())
    assert sent[-1, -1] == pytest.approx(cost[(message.height - 1) * side :, (message.width - 1) * side :].min())


def test_a_differential_base_cannot_keep_its_heading():
    with pytest.raises(UserError, match="cannot keep its heading"):
        ControllerSettings(drive="differential", heading="keep").check()
