"""The simulator service: pause, single steps, and speed."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np
import pytest
from structlog.testing import capture_logs

from common.bus.inbox import Call, Inbox
from common.errors import UserError
from common.messages.definitions import CmdVel, Twist
from common.messages.requests import Request, ResetRequest, SpeedRequest
from common.messages.topics import PAUSE, RESET, RESUME, SCAN, SPEED, STEP, TRUTH, WORLD
from common.runtime.service import Loop
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

    def ask(self, query, request=None):
        """Send a request and return the reply."""
        answers = []
        payload = (request or Request()).encode()
        self.loop._answer(Call(query, payload, lambda p: answers.append(query.reply.decode(p)), answers.append))
        (answer,) = answers
        return answer

    def scans(self):
        """Stamps, in periods, of the scans sent since the last call."""
        found = [SCAN.message.decode(payload).stamp_ns / PERIOD_NS for topic, payload in self.bus.sent if topic is SCAN]
        self.bus.sent.clear()
        return [round(stamp) for stamp in found]

    def command(self, number, vx):
        self.service.on_message(None, CmdVel(stamp_ns=number * PERIOD_NS, twist=Twist(vx=vx)))

    def run(self, seconds):
        """Advance the clock, and call the timer when it is due."""
        end = self.clock.now + seconds
        while True:
            due = self.service.due()
            if due is None or self.clock.now + due > end:
                break
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
        loop = Loop(service, bus, Inbox())
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
        refused = running.ask(STEP)
        assert not refused.ok
        assert "pause first" in refused.reason
        assert running.ask(PAUSE).ok
        assert running.service.due() is None
        for number in (1, 2, 3):
            running.clock.now += 10.0
            assert running.ask(STEP).ok
            assert running.scans() == [number]
        assert running.service.counters["late"] == 0
        assert running.ask(RESUME).ok
        assert running.service.due() <= 0
        running.service.on_timer()
        assert running.scans() == [4]


def test_steps_move_the_robot_like_running_time(simulator):
    def poses(running):
        return [TRUTH.message.decode(p).pose.array() for topic, p in running.bus.sent if topic is TRUTH]

    with simulator() as stepped, simulator() as run:
        for each in (stepped, run):
            each.service.on_timer()
        stepped.ask(PAUSE)
        for number in range(6):
            stepped.command(number, 0.8)
            run.command(number, 0.8)
            stepped.ask(STEP)
            run.service.on_timer()
        assert np.array_equal(poses(stepped), poses(run))
        assert np.hypot(*(poses(run)[-1] - poses(run)[0])[:2]) > 0.05


def test_stop_command_during_a_pause_is_ignored(simulator):
    with simulator() as running:
        running.service.on_timer()
        running.ask(PAUSE)
        running.command(0, 0.8)
        running.command(0, 0.0)
        running.ask(STEP)
        assert running.service.simulation.physics.twist()[1] == pytest.approx(0, abs=1e-6)
        assert abs(running.service.simulation.physics.twist()[0]) > 0.05
        assert running.service.counters["stale_commands"] == 1


def test_step_in_lockstep_needs_the_command(simulator):
    with simulator(pace="lockstep", wait_for="") as running:
        running.service.on_timer()
        running.ask(PAUSE)
        assert running.scans() == [0]
        early = running.ask(STEP)
        assert not early.ok
        assert "sent again" in early.reason
        assert running.scans() == [0]
        running.command(0, 0.5)
        assert running.scans() == []
        assert running.ask(STEP).ok
        assert running.scans() == [1]
        assert not running.ask(STEP).ok


def test_step_after_a_reset_is_the_first_scan(simulator):
    with simulator() as running:
        running.service.on_timer()
        running.ask(PAUSE)
        running.ask(STEP)
        running.ask(RESET, ResetRequest(seed=3))
        running.scans()
        assert running.ask(STEP).ok
        assert running.scans() == [0]


def test_no_step_before_required_services_run(simulator):
    with simulator(wait_for="estimator") as running:
        running.ask(PAUSE)
        reply = running.ask(STEP)
        assert not reply.ok
        assert "waits for estimator" in reply.reason
        assert running.scans() == []
        running.ask(RESUME)
        assert running.service.note == "waits for estimator"


@pytest.mark.parametrize("factor", [0.1, 0.5, 1.0, 4.0, 20.0])
def test_speed_factor(simulator, factor):
    with simulator() as running:
        running.run(1.0)
        assert len(running.scans()) in {15, 16}
        assert running.ask(SPEED, SpeedRequest(factor=factor)).ok
        running.run(2.0)
        assert len(running.scans()) == pytest.approx(30 * factor, abs=1)
        assert running.service.note == ("" if factor == 1 else f"runs at {factor:g} x real time")


def test_higher_speed_takes_effect_at_once(simulator):
    with simulator() as running:
        running.ask(SPEED, SpeedRequest(factor=0.1))
        running.run(0.01)
        running.scans()
        running.ask(SPEED, SpeedRequest(factor=10.0))
        running.run(0.1)
        assert len(running.scans()) in {14, 15}


def test_note_shows_pause_before_speed(simulator):
    with simulator() as running:
        running.ask(SPEED, SpeedRequest(factor=2.0))
        running.ask(PAUSE)
        assert running.service.note == "paused"
        running.ask(RESUME)
        assert running.service.note == "runs at 2 x real time"


@pytest.mark.parametrize(("pace", "why"), [("lockstep", "each scan waits"), ("fast", "as fast as it can")])
def test_speed_is_refused_at_other_paces(simulator, pace, why):
    with simulator(pace=pace) as running:
        reply = running.ask(SPEED, SpeedRequest(factor=2.0))
        assert not reply.ok
        assert why in reply.reason
        assert running.service.speed == 1.0


def test_people_stop_during_a_pause_and_restart_with_a_reset(simulator):
    def people(running):
        return TRUTH.message.decode([p for topic, p in running.bus.sent if topic is TRUTH][-1]).people

    with simulator(world="office", people=5, seed=2) as running:
        running.service.on_timer()
        began = people(running)
        assert began.shape == (5, 2)
        running.run(2.0)
        walked = people(running)
        assert (walked != began).any()
        running.ask(PAUSE)
        running.run(5.0)
        running.ask(STEP)
        one = people(running)
        assert np.hypot(*(one - walked).T).max() < 0.07  # one period at 1 m/s
        for seed, same in ((None, True), (3, False), (2, True)):
            running.ask(RESET, ResetRequest(seed=seed))
            running.ask(STEP)
            assert np.array_equal(people(running), began) == same


def test_world_reply_does_not_contain_people(simulator):
    with simulator(world="office", people=5) as peopled, simulator(world="office") as plain:
        assert peopled.ask(WORLD).encode() == plain.ask(WORLD).encode()


@pytest.mark.parametrize("stop", [True, False])
def test_warning_without_the_obstacle_stop(simulator, stop):
    with capture_logs() as lines, simulator(obstacle_stop=stop) as running:
        assert running.service.simulation.setup.obstacle_stop is stop
    warnings = [line for line in lines if line["event"].startswith("the obstacle stop is off")]
    assert [line["log_level"] for line in warnings] == ([] if stop else ["warning"])


def test_too_many_people_raise_a_user_error(simulator, tmp_path):
    closet = tmp_path / "closet.yaml"
    closet.write_text("{name: closet, boundary: [[0, 0], [4, 0], [4, 4], [0, 4]]}")
    with pytest.raises(UserError, match=r"'closet' has room for \d+ people, .* not for 20: ask for fewer"):
        simulator(people=20, world=str(closet)).__enter__()
