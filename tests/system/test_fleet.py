"""One estimator process for several robots, with real simulators on a real bus."""

from __future__ import annotations

import numpy as np
import pytest

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.messages.definitions import Belief, Health, Truth
from common.messages.requests import ConfigReply, ModelReply, ModelRequest, Request
from common.messages.topics import BELIEF, CONFIG, HEALTH, MODEL, SCAN, TRUTH
from services.estimator.multi_robot import key_expression
from tests.conftest import WAIT_TIMEOUT_S

NUMBERS = (1, 2, 3)
STARTS = {1: "3,1.5,90", 2: "9,1.5,0", 3: "14,1.5,90"}
MAX_ERROR = 0.15  # m, with 181 beams


class RobotListener:
    """Receives the beliefs, true states and health messages of one robot."""

    def __init__(self, bus, robot):
        self.robot, self._inbox, self._truths = robot, Inbox(), {}
        for topic in (BELIEF, TRUTH, HEALTH):
            bus.subscribe(topic, self._inbox, keep_all=True, robot=robot)

    def matches(self, condition):
        """Whether one of the messages received since the last call meets the condition."""
        while isinstance(sample := self._inbox.get(0), Sample):
            message = sample.topic.message.decode(sample.payload)
            if isinstance(message, Truth):
                self._truths[message.stamp_ns] = message
            if condition(message):
                return True
        return False

    def discard_messages(self):
        while self._inbox.get(0) is not None:
            pass
        self._truths.clear()

    def localised(self, message):
        truth = self._truths.get(message.stamp_ns)
        if not isinstance(message, Belief) or message.state != "tracking" or truth is None:
            return False
        return np.hypot(message.pose.x - truth.pose.x, message.pose.y - truth.pose.y) < MAX_ERROR

    def wait(self, condition, what, timeout=WAIT_TIMEOUT_S):
        assert wait_until(lambda: self.matches(condition), timeout), f"{self.robot}: not {what}"


@pytest.fixture
def names(link):
    return {k: f"{link.robot}-{k}" for k in NUMBERS}


@pytest.fixture
def simulate(process, names):
    def start(k, where=None):
        return process(
            "simulator", "--beams", "181", "--start", where or STARTS[k], "--seed", str(k),
            env={"PRESAGE_ROBOT": names[k]},
        )  # fmt: skip

    return start


def test_one_estimator_for_three_robots(process, bus, link, names, simulate):
    estimator = process("estimator", "--robots", f"{names[1]},{link.robot}-?", "--forget", "1.5")
    listeners = {k: RobotListener(bus, name) for k, name in names.items()}
    simulators = {k: simulate(k) for k in NUMBERS}
    for listener in listeners.values():
        listener.wait(listener.localised, "localised")

    # Seen from outside, each robot has its own estimator.
    for listener in listeners.values():
        assert wait_until(lambda r=listener.robot: "estimator" in bus.alive(robot=r), 30)
        listener.wait(
            lambda m, r=listener.robot: (
                isinstance(m, Health)
                and m.service == "estimator"
                and {row.key for row in m.topics if row.published} >= {BELIEF.key(r)}
                and all(
                    row.key.startswith(f"presage/{r}/") for row in m.topics if "/" in row.key
                )  # the other rows are of requests
            ),
            "healthy",
        )
        config = bus.query(
            CONFIG, Request(), ConfigReply, service="estimator", robot=listener.robot, timeout=WAIT_TIMEOUT_S
        )
        assert f'"robot": "{listener.robot}"' in config.config
        assert bus.query(MODEL, ModelRequest(), ModelReply, robot=listener.robot, timeout=WAIT_TIMEOUT_S).ok

    # Malformed scans of one robot are counted for that robot and do not affect the others.
    garbage, before = bus.for_robot(names[2]), Inbox()
    assert garbage.wait_matching(SCAN, 10)
    bus.subscribe(BELIEF, before, keep_all=True, robot=names[1])
    for k in range(1000):
        garbage.put(SCAN, bytes([k % 256]) * (k % 300))
    listeners[2].wait(
        lambda m: isinstance(m, Health) and m.service == "estimator" and m.counters.get("other_sources", 0) > 0,
        "notified of scans from another source",
    )
    for listener in listeners.values():
        listener.discard_messages()
        listener.wait(listener.localised, "localised after the malformed scans")
    stamps = [BELIEF.message.decode(s.payload).stamp_ns for s in iter(lambda: before.get(0), None)]
    assert len(stamps) == len(set(stamps)) > 0

    # A robot found by a pattern is dropped when it is gone and localised again later; a named robot keeps its keys.
    simulators[1].stop()
    simulators[2].stop()
    assert wait_until(lambda: "estimator" not in bus.alive(robot=names[2]), 30)
    estimator.wait_for(f"robot={names[1]} seconds=1.5")
    assert wait_until(lambda: "estimator" in bus.alive(robot=names[1]), 30)
    for k in (1, 2):
        listeners[k].discard_messages()
        simulate(k, "6,2,45")
    for listener in (listeners[1], listeners[2]):
        listener.wait(listener.localised, "localised after it came back")
    listeners[3].discard_messages()
    listeners[3].wait(listeners[3].localised, "served all the time")
    assert "Traceback" not in estimator.output
    assert estimator.stop() == 0


def test_robot_limit(process, bus, link, names, simulate):
    own = process("estimator", env={"PRESAGE_ROBOT": names[1]})
    assert wait_until(lambda: "estimator" in bus.alive(robot=names[1]), 60)
    simulators = [simulate(k) for k in NUMBERS]
    assert wait_until(lambda: all("simulator" in bus.alive(robot=name) for name in names.values()), 60)
    fleet = process("estimator", "--robots", f"{link.robot}-*", "--max-robots", "1")
    fleet.wait_for("too many robots")
    fleet.wait_for("ready robot=")
    served = [k for k in (2, 3) if f"ready robot={names[k]}" in fleet.output]
    assert len(served) == 1
    assert f"robot={names[1]}" not in fleet.output
    own.stop()
    simulators[served[0] - 1].stop()


@pytest.mark.parametrize(
    ("pattern", "hears", "not_heard"),
    [("*", "a-1", ""), ("a-*", "a-1", "b-1"), ("a-?", "a-1", "b-1"), ("*-1", "b-1", "b-2"), ("??", "ab", "")],
)
def test_robot_patterns(bus, link, pattern, hears, not_heard):
    prefix = "" if pattern in {"*", "??"} else link.robot
    inbox = Inbox()
    bus.subscribe(SCAN, inbox, keep_all=True, robot=key_expression(prefix + pattern))
    with open_bus(link) as other:
        for robot in filter(None, (not_heard, hears)):
            there = other.for_robot(prefix + robot)
            if robot == hears:
                assert there.wait_matching(SCAN, 10)
            there.put(SCAN, b"x")
    heard = []
    assert wait_until(lambda: heard.append(inbox.get(0)) or heard[-1] is not None, 10)
    assert heard[-1].key == SCAN.key(prefix + hears)
