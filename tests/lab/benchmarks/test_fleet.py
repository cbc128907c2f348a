"""The search for the largest number of robots served, and the load of scans."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.geometry.world import load_world
from common.messages.definitions import Belief, Pose
from common.messages.topics import BELIEF, SCAN
from lab.benchmarks.fleet import max_robots_served
from lab.benchmarks.fleet_load import CLEARANCE, RADIUS, FleetLoad
from tests.conftest import WAIT_TIMEOUT_S


@pytest.mark.parametrize("limit", [0, 1, 2, 3, 7, 8, 9, 15, 16, 31, 32])
def test_largest_number_served(limit):
    tried = []

    def served(count):
        tried.append(count)
        return count <= limit

    assert max_robots_served(served, 32) == limit
    assert len(tried) == len(set(tried)) <= 7
    assert all(1 <= count <= 32 for count in tried)


def test_load(bus):
    world = load_world("corridor")
    load = FleetLoad(bus, world, 16, 15.0, 3, 1)
    inbox = Inbox()
    bus.subscribe(SCAN, inbox, keep_all=True, robot="*")
    assert load.wait_matching(3, 10)
    for robot in load.robots:
        ranges = world.ray_distances(robot.pose(7, 15.0)[None], np.linspace(-np.pi, np.pi, 90))
        assert ranges.min() >= CLEARANCE - RADIUS - 0.05
    window = load.play(2, 0.2)
    assert window.sent == 6
    assert window.answered == window.tracking == 0
    assert window.in_time_share == 0
    assert window.percentile(50) is None
    stamps = {}

    def received():
        while isinstance(sample := inbox.get(0), Sample):
            stamps.setdefault(sample.key.split("/")[1], []).append(SCAN.message.decode(sample.payload).stamp_ns)
        return sum(map(len, stamps.values()))

    assert wait_until(lambda: received() == 6, WAIT_TIMEOUT_S)
    load.play(2, 0.1)
    assert wait_until(lambda: received() == 8, WAIT_TIMEOUT_S)
    for of_one in stamps.values():
        assert np.diff(of_one).tolist() == pytest.approx([1e9 / 15] * 3, abs=2)


def test_counted_answers(bus, link):
    """A peer answers every scan of the first robot twice, and once with an unknown stamp."""
    load = FleetLoad(bus, load_world("corridor"), 16, 15.0, 2, 1)
    with open_bus(link) as other:
        answering = other.for_robot(load.robots[0].name)
        inbox = Inbox()
        other.subscribe(SCAN, inbox, keep_all=True, robot=load.robots[0].name)

        def answer():
            while not ending.is_set():
                if isinstance(sample := inbox.get(0.05), Sample):
                    stamp = SCAN.message.decode(sample.payload).stamp_ns
                    for each in (stamp, stamp, stamp + 1):
                        answering.put(BELIEF, belief(each))

        ending = threading.Event()
        thread = threading.Thread(target=answer)
        thread.start()
        try:
            assert load.wait_matching(1, 10)
            assert answering.wait_matching(BELIEF, 10)
            window = load.play(2, 0.4)
        finally:
            ending.set()
            thread.join()
    assert (window.sent, window.answered, window.tracking) == (12, 6, 1)
    assert len(window.latency_ms) == 6
    assert (window.latency_ms > 0).all()


def belief(stamp):
    return Belief(
        stamp_ns=stamp, state="tracking", pose=Pose(x=1.0, y=1.0), covariance=None, xi=np.zeros(3, np.float32),
        curvature=np.eye(3), free_energy=0.0, accuracy=0.0, complexity=0.0, estimator="precise",
    ).encode()  # fmt: skip
