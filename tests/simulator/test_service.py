"""The simulator service: pause, single steps, and speed."""

from __future__ import annotations

from contextlib import contextmanager
from unittest.mock import Mock

import numpy as np
import pytest
from structlog.testing import capture_logs

from common.bus.inbox import Inbox, IncomingRequest
from common.errors import UserError
from common.messages.definitions import CmdVel, Pose, Twist
from common.messages.requests import PoseRequest, Request, ResetRequest, SpeedRequest
from common.messages.topics import PAUSE, RESET, RESUME, SCAN, SPEED, STEP, TELEPORT, TRUTH, WORLD
from common.runtime.service import ServiceLoop
from services.simulator import service as shell
from services.simulator.service import SimulatorService
from services.simulator.settings import SimulatorSettings
from tests.process_replay.harness import FakeBus

PERIOD_NS = 66_666_667


class Clock:
    """Stands in for the module `time`."""

    now = 1000.0

    def monotonic(self):
        return self.now


class Running:
    """A simulator without a bus, with a clock that the test controls."""

    def __init__(self, service, loop, bus, clock):
        self.service, self.loop, self.bus, self.clock = service, loop, bus, clock

    def request(self, query, request=None):
        """Sends a request and returns the reply."""
        replies = []
        payload = (request or Request()).encode()
        self.loop._answer(
            IncomingRequest(query, payload, lambda p: replies.append(query.reply.decode(p)), replies.append)
        )
        (reply,) = replies
        return reply

    def sent(self, topic):
        """Messages sent since the last call."""
        found = [topic.message.decode(payload) for sent_topic, payload in self.bus.sent if sent_topic is topic]
        self.bus.sent.clear()
        return found

    def scans(self):
        """Stamps, in periods, of the scans sent since the last call."""
        return [round(scan.stamp_ns / PERIOD_NS) for scan in self.sent(SCAN)]

    def command(self, number, vx):
        self.service.on_message(None, CmdVel(stamp_ns=number * PERIOD_NS, twist=Twist(vx=vx)))

    def run(self, seconds):
        """Advances the clock, and calls the timer when it is due."""
        end = self.clock.now + seconds
        while (due := self.service.due()) is not None and self.clock.now + due <= end:
            self.clock.now += max(0.0, due)
            self.service.on_timer()
        self.clock.now = end


@pytest.fixture
def simulator(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(shell, "time", clock)

    @contextmanager
    def run(**settings):
        service, bus = SimulatorService(SimulatorSettings(beams=61, **settings)), FakeBus()
        loop = ServiceLoop(service, bus, Inbox())
        service.open()
        try:
            yield Running(service, loop, bus, clock)
        finally:
            service.close()

    return run


@pytest.mark.parametrize("pace", ["realtime", "fast"])
def test_steps_only_while_paused(simulator, pace):
    with simulator(pace=pace) as running:
        running.service.on_timer()
        assert running.scans() == [0]
        refused = running.request(STEP)
        assert not refused.ok
        assert "pause first" in refused.reason
        assert running.request(PAUSE).ok
        assert running.service.due() is None
        for number in (1, 2, 3):
            running.clock.now += 10.0
            assert running.request(STEP).ok
            assert running.scans() == [number]
        assert running.service.counters["late"] == 0
        assert running.request(RESUME).ok
        assert running.service.due() <= 0
        running.service.on_timer()
        assert running.scans() == [4]


def test_teleport_to_a_floor(simulator, tmp_path):
    path = tmp_path / "tower.yaml"
    path.write_text("{name: tower, floors: {ground: corridor, first: office}}")
    with simulator(world=str(path)) as running:
        assert running.request(TELEPORT, PoseRequest(pose=Pose(x=3.0, y=2.0), map_id="first")).ok
        running.service.on_timer()
        truth, world = running.sent(TRUTH)[-1].pose.array(), running.request(WORLD).world
        assert world.floor_at(truth).name == "first"
        np.testing.assert_allclose(world.floor("first").from_map(truth), [3, 2, 0], atol=1e-6)
        refused = running.request(TELEPORT, PoseRequest(pose=Pose(x=3.0, y=2.0), map_id="attic"))
        assert (refused.ok, refused.reason) == (False, "there is no floor 'attic': choose one of ground, first")


def test_stop_during_a_pause(simulator):
    with simulator() as running:
        running.service.on_timer()
        running.request(PAUSE)
        running.command(0, 0.8)
        running.command(0, 0.0)
        running.request(STEP)
        # At its stamp, a scan after the first, the robot has accelerated at 1 m/s² for a period less a sweep of 3/4.
        assert running.sent(TRUTH)[-1].twist.vx == pytest.approx(1 / 60, rel=0.01)
        assert running.service.counters["stale_commands"] == 1


def test_step_in_lockstep_needs_the_command(simulator):
    with simulator(pace="lockstep", wait_for="") as running:
        running.service.on_timer()
        running.request(PAUSE)
        assert running.scans() == [0]
        early = running.request(STEP)
        assert not early.ok
        assert "sent again" in early.reason
        assert running.scans() == [0]
        running.command(0, 0.5)
        assert running.scans() == []
        assert running.request(STEP).ok
        assert running.scans() == [1]
        assert not running.request(STEP).ok


def test_step_after_a_reset(simulator):
    with simulator() as running:
        running.service.on_timer()
        for query, request in ((PAUSE, None), (STEP, None), (RESET, ResetRequest(seed=3))):
            running.request(query, request)
        running.scans()
        assert running.request(STEP).ok
        assert running.scans() == [0]


def test_no_step_before_required_services_run(simulator):
    with simulator(wait_for="estimator") as running:
        running.request(PAUSE)
        reply = running.request(STEP)
        assert not reply.ok
        assert "waits for estimator" in reply.reason
        assert running.scans() == []
        running.request(RESUME)
        assert running.service.note == "waits for estimator"


@pytest.mark.parametrize("factor", [0.1, 1.0, 8.0])
def test_speed_factor(simulator, factor):
    with simulator() as running:
        running.run(1.0)
        assert len(running.scans()) in {15, 16}
        assert running.request(SPEED, SpeedRequest(factor=factor)).ok
        running.run(1.0)
        assert len(set(running.scans())) == pytest.approx(15 * factor, abs=1)
        note = "" if factor == 1 else f"runs at {factor:g} x real time"
        assert running.service.note == note
        running.request(PAUSE)
        assert running.service.note == "paused"
        running.request(RESUME)
        assert running.service.note == note


def test_slow_motion(simulator):
    """The controller hears of the present scan often enough not to stop the robot for want of beliefs."""
    with simulator() as running:
        running.service.on_timer()
        running.request(SPEED, SpeedRequest(factor=0.1))
        running.scans()
        stamps = []
        for _ in range(20):
            running.run(shell.REPEAT_S)
            sent = running.scans()
            assert sent
            stamps += sent
        assert set(stamps) == set(range(stamps[0], stamps[0] + 6))
        assert stamps == sorted(stamps)
        running.request(PAUSE)
        running.run(1.0)
        assert running.scans() == []


def test_refused_reset(simulator, monkeypatch):
    """The simulation goes on if another one cannot be made."""
    with simulator() as running:
        running.run(1.0)
        running.scans()
        monkeypatch.setattr(shell, "Simulation", Mock(side_effect=UserError("no room for 22 people")))
        assert running.request(RESET, ResetRequest(seed=1)).reason == "no room for 22 people"
        running.run(1.0)
        assert min(running.scans()) > 10


def test_higher_speed_takes_effect_at_once(simulator):
    with simulator() as running:
        running.request(SPEED, SpeedRequest(factor=0.1))
        running.run(0.01)
        running.scans()
        running.request(SPEED, SpeedRequest(factor=10.0))
        running.run(0.1)
        assert len(running.scans()) in {14, 15}


@pytest.mark.parametrize(("pace", "reason"), [("lockstep", "each scan waits"), ("fast", "as fast as it can")])
def test_speed_is_refused_at_other_paces(simulator, pace, reason):
    with simulator(pace=pace) as running:
        reply = running.request(SPEED, SpeedRequest(factor=2.0))
        assert not reply.ok
        assert reason in reply.reason
        assert running.service.speed == 1.0


def test_people_at_pause_and_reset(simulator):
    with simulator(world="office", people=5, seed=2) as running, simulator(world="office") as plain:
        assert running.request(WORLD).encode() == plain.request(WORLD).encode()  # without people
        running.service.on_timer()
        began = running.sent(TRUTH)[-1].people
        assert began.shape == (5, 2)
        running.run(2.0)
        walked = running.sent(TRUTH)[-1].people
        assert (walked != began).any()
        running.request(PAUSE)
        running.run(5.0)
        running.request(STEP)
        assert np.hypot(*(running.sent(TRUTH)[-1].people - walked).T).max() < 0.07  # one period at 1 m/s
        for seed, same in ((None, True), (3, False), (2, True)):
            running.request(RESET, ResetRequest(seed=seed))
            running.request(STEP)
            assert np.array_equal(running.sent(TRUTH)[-1].people, began) == same


@pytest.mark.parametrize("stop", [True, False])
def test_warning_without_the_obstacle_stop(simulator, stop):
    with capture_logs() as lines, simulator(obstacle_stop=stop) as running:
        assert running.service.simulation.setup.obstacle_stop is stop
    warnings = [line["log_level"] for line in lines if line["event"].startswith("the obstacle stop is off")]
    assert warnings == ([] if stop else ["warning"])
