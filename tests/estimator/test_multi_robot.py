"""Several robots in one process: the results of each are as if it were alone, and searches delay no other robot."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Inbox
from common.errors import UserError
from common.geometry import se2
from common.messages.definitions import Belief, Health, Pose, Scan
from common.messages.requests import LocaliseRequest, Reply
from common.messages.topics import BELIEF, HEALTH, LOCALISE, SCAN
from services.estimator import multi_robot
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.settings import EstimatorSettings
from services.estimator.shared.interface import Hypothesis, Observation, Posterior
from tests.conftest import WAIT_TIMEOUT_S, received_messages
from tests.estimator.models import ROOM, SCANNER


def drive(seed, count=12):
    """Scans of a robot that is carried elsewhere half-way."""
    rng = np.random.default_rng(seed)
    starts = np.column_stack([ROOM.sample_free(2, rng, 0.5), rng.uniform(-3, 3, 2)])
    poses = np.repeat(starts, count // 2, axis=0)
    clean = ROOM.ray_distances(se2.compose(poses, SCANNER.mount), SCANNER.angles())
    noisy = clean + 0.02 * rng.standard_normal(clean.shape)
    return [Observation(row, SCANNER.angles(), SCANNER.range_max, k / 15) for k, row in enumerate(noisy)]


def results(posteriors):
    return [(p.state, p.pose.tobytes(), p.covariance.tobytes(), p.free_energy) for p in posteriors]


def test_robots_in_two_threads():
    factory, scans = prepare_factory(EstimatorOptions(ROOM, model="exact")), [drive(1), drive(2)]
    alone = []
    for each in scans:
        estimator = factory(ScannerGeometry.of(SCANNER))
        alone.append(results([estimator.update(scan) for scan in each]))
    estimators, found = [factory(ScannerGeometry.of(SCANNER)) for _ in scans], [[], []]

    def run(k):
        found[k] = [estimators[k].update(scan) for scan in scans[k]]

    threads = [threading.Thread(target=run, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [results(each) for each in found] == alone


def test_track_and_search_are_update():
    factory, scans, searches = prepare_factory(EstimatorOptions(ROOM, model="exact")), drive(1), []
    one, other = factory(ScannerGeometry.of(SCANNER)), factory(ScannerGeometry.of(SCANNER))
    with pytest.raises(RuntimeError, match="track first"):
        one.search()
    for k, scan in enumerate(scans):
        posterior = one.track(scan)
        if posterior is None:
            searches.append(k)
            posterior = one.search()
        assert results([posterior]) == results([other.update(scan)])
    assert {0, len(scans) // 2} <= set(searches)
    assert len(searches) < len(scans) / 2


class SearchingStub:
    """Tracks scans of 1 m. Those of 2 m need a search, which waits for ``proceed``; at 3 m the search fails."""

    name, proceed = "stub", threading.Event()

    def track(self, observation):
        self.distance = observation.ranges[0]
        return self.posterior() if self.distance == 1 else None

    def search(self):
        assert self.proceed.wait(WAIT_TIMEOUT_S)
        if self.distance == 3:
            raise ArithmeticError
        return self.posterior()

    def posterior(self):
        at = Hypothesis(np.array([self.distance, 0, 0]), np.eye(3), 1.0)
        return Posterior("tracking", (at,), 0.0, 0.0, np.zeros(3), np.eye(3), np.ones(5))

    def restart(self, pose=None):
        pass


class Robot:
    """The other side: sends scans, receives beliefs."""

    def __init__(self, bus, name):
        self.bus, self.name, self.beliefs, self.failed, self._inbox = bus.for_robot(name), name, [], 0, Inbox()
        for topic in (BELIEF, HEALTH):
            self.bus.subscribe(topic, self._inbox, keep_all=True)

    def send(self, stamp, distance):
        scan = Scan(
            stamp_ns=stamp, angle_min=0.0, angle_increment=0.1, range_min=0.1, range_max=9.0,
            ranges=np.full(5, float(distance)), mount=Pose(x=0.0, y=0.0),
        )  # fmt: skip
        self.bus.put(SCAN, scan.encode())

    def has(self, *stamps):
        for message in received_messages(self._inbox, Belief | Health):
            if isinstance(message, Belief):
                self.beliefs.append(message.stamp_ns)
            else:
                self.failed = message.counters["failed"]
        return self.beliefs == list(stamps)


def searching(loop):
    """Whether each robot is known, and waits for its search."""
    known = list(loop._robots.values())
    return len(known) == len(loop.settings.robots.split(",")) and all(robot.search for robot in known)


@pytest.fixture
def fleet(bus, link, monkeypatch):
    """A function that runs the loop for robots, and returns it and the robots."""
    models = SimpleNamespace(world=ROOM, factory=lambda _: SearchingStub(), describe=lambda _: "none")
    monkeypatch.setattr(multi_robot, "SharedModels", lambda _: models)
    SearchingStub.proceed.clear()
    running = []

    def start(*names, **settings):
        names = [f"{link.robot}-{name}" for name in names]
        session = open_bus(link)
        loop = multi_robot.FleetLoop(EstimatorSettings(robots=",".join(names), **settings), session.__enter__())
        thread = threading.Thread(target=loop.run)
        running.append((loop, thread, session))
        robots = [Robot(bus, name) for name in names]
        thread.start()
        for robot in robots:
            assert robot.bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
        return loop, thread, *robots

    yield start
    SearchingStub.proceed.set()
    for loop, thread, session in running:
        loop.stop()
        thread.join()
        session.__exit__(None, None, None)


def test_a_robot_with_another_protocol_is_left_out(bus, monkeypatch):
    monkeypatch.setattr(multi_robot, "SharedModels", lambda _: None)
    loop = multi_robot.FleetLoop(EstimatorSettings(robots=f"{bus.robot}-*"), bus)
    loop._note_liveliness(f"{bus.robot}-old", "simulator", True)
    opening = Mock(side_effect=UserError("another protocol"))
    monkeypatch.setattr(multi_robot.ServiceLoop, "open", opening)
    loop.models = None
    loop._add_found_robots()
    loop._add_found_robots()
    assert (loop._robots, opening.call_count) == ({}, 1)  # not tried again at once


def test_a_named_robot_with_another_protocol_is_tried_again(bus, monkeypatch):
    """Nor does it end the process, in which the other robots are served."""
    monkeypatch.setattr(multi_robot, "SharedModels", lambda _: None)
    other, good = f"{bus.robot}-old", f"{bus.robot}-new"
    loop = multi_robot.FleetLoop(EstimatorSettings(robots=f"{other},{good}"), bus)
    loop.models = None
    monkeypatch.setattr(multi_robot.ServiceLoop, "open", lambda loop: check(loop.bus.robot))
    monkeypatch.setattr(multi_robot.ServiceLoop, "try_start", lambda _: True)
    monkeypatch.setattr(multi_robot.ServiceLoop, "publish_health_if_due", lambda loop: check(loop.bus.robot))
    outdated = set()

    def check(robot):
        if robot in outdated:
            raise UserError("another protocol")

    def turn():
        loop._next_health_check = loop._next_discovery = 0.0
        loop._step()
        return set(loop._robots)

    loop._stopping = True  # no turn waits
    assert turn() == {other, good}
    outdated.add(other)
    assert turn() == {good}
    outdated.clear()
    assert turn() == {good}  # not at once
    loop._retry_at[other] = 0.0
    assert turn() == {other, good}


def test_search_beside_tracking(fleet):
    _, _, a, b = fleet("a", "b")
    a.send(1, 2)
    for stamp in range(1, 6):
        b.send(stamp, 1)
        assert wait_until(lambda s=stamp: b.has(*range(1, s + 1)), WAIT_TIMEOUT_S)
    for stamp in (2, 3, 4):
        a.send(stamp, 1)
    b.send(6, 1)
    assert wait_until(lambda: b.has(*range(1, 7)), WAIT_TIMEOUT_S)
    assert a.has()
    SearchingStub.proceed.set()
    assert wait_until(lambda: a.has(1, 4), WAIT_TIMEOUT_S)  # of the scans during the search, the newest


def test_failed_search(fleet):
    _, _, a = fleet("a")
    SearchingStub.proceed.set()
    a.send(1, 3)
    assert wait_until(lambda: a.has() and a.failed == 1, WAIT_TIMEOUT_S)
    a.send(2, 1)
    assert wait_until(lambda: a.has(2), WAIT_TIMEOUT_S)


def test_request_during_a_search(fleet):
    loop, _, a = fleet("a")
    a.send(1, 2)
    assert wait_until(lambda: searching(loop), WAIT_TIMEOUT_S)
    threading.Timer(0.3, SearchingStub.proceed.set).start()
    assert a.bus.query(LOCALISE, LocaliseRequest(), Reply, timeout=WAIT_TIMEOUT_S).ok
    assert wait_until(lambda: a.has(1), WAIT_TIMEOUT_S)


def test_robot_forgotten_during_its_search(fleet):
    loop, _, a, b = fleet("a", "b")
    a.send(1, 2)
    b.send(1, 2)
    assert wait_until(lambda: searching(loop), WAIT_TIMEOUT_S)
    # Not before: on a busy machine the robots would be forgotten between two looks.
    loop.settings = loop.settings.model_copy(update={"forget": 0.3})
    assert wait_until(lambda: not any(robot.search for robot in loop._robots.values()), WAIT_TIMEOUT_S)
    SearchingStub.proceed.set()
    for robot in (a, b):
        robot.send(2, 1)
        assert wait_until(lambda r=robot: r.has(2), WAIT_TIMEOUT_S)


def test_stop_during_a_search(fleet):
    loop, thread, a, b = fleet("a", "b")
    a.send(1, 2)
    b.send(1, 2)  # waits for the search of a
    assert wait_until(lambda: searching(loop), WAIT_TIMEOUT_S)
    loop.stop()
    SearchingStub.proceed.set()
    thread.join(WAIT_TIMEOUT_S)
    assert not thread.is_alive()
    assert a.has()
    assert b.has()
