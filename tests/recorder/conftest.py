"""A recorder as a process, requests to it, and a service that describes itself to it."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator

import pytest

from common.bus.bus import Bus, wait_until
from common.bus.inbox import Inbox
from common.messages.definitions import Health, Odom, Pose, TopicHealth, Twist
from common.messages.requests import RecordReply, RecordRequest, WorldReply
from common.messages.topics import HEALTH, ODOM, RECORDING, WORLD
from common.robot.robot import Robot
from common.runtime.service import Service, ServiceLoop
from services.recorder import recording
from services.recorder.files.writer import RecordingWriter
from services.recorder.settings import RecorderSettings
from tests.conftest import WAIT_TIMEOUT_S, Running
from tests.recorder import sessions


@pytest.fixture
def logs(tmp_path):
    return tmp_path / "logs"


@pytest.fixture
def small_chunks(monkeypatch):
    """Lets `OpenRecording` write chunks of 1 kB."""
    monkeypatch.setattr(recording, "RecordingWriter", functools.partial(RecordingWriter, chunk_size=1024))


@pytest.fixture
def recorder(process, logs):
    """A function that starts a recorder, and returns it when it is ready."""

    def start(*args: str) -> Running:
        running: Running = process("recorder", "--directory", str(logs), "--flush", "0.1", *args)
        running.wait_for("ready")
        return running

    return start


@pytest.fixture
def request_recording(bus):
    """A function that sends a RecordRequest."""

    def send(action: str) -> RecordReply:
        reply: RecordReply = bus.query(RECORDING, RecordRequest(action=action), RecordReply, timeout=WAIT_TIMEOUT_S)
        return reply

    return send


@pytest.fixture
def recorder_health(bus):
    """A function that waits until the recorder's health meets a condition on the message and its row of odom."""
    inbox, own = Inbox(), HEALTH.key(bus.robot, "recorder")
    bus.subscribe(HEALTH, inbox, keep_all=True)

    def wait(condition: Callable[[Health, TopicHealth], bool]) -> None:
        def met() -> bool:
            while (entry := inbox.get(0)) is not None:
                if entry.key == own:
                    health = Health.decode(entry.payload)
                    rows = {row.key: row for row in health.topics}
                    if condition(health, rows.get(ODOM.key(bus.robot), TopicHealth(key=""))):
                        return True
            return False

        assert wait_until(met, WAIT_TIMEOUT_S)

    return wait


def publish_odometry(bus: Bus, numbers: range | list[int]) -> list[bytes]:
    """Publishes odometry with these sequence numbers. Returns the payloads."""
    assert bus.wait_matching(ODOM, 20)
    payloads = []
    for number in numbers:
        odom = Odom(stamp_ns=number, seq=number, pose=Pose(x=0, y=0), twist=Twist(), covariance=[[0.0] * 3] * 3)
        payloads.append(odom.encode())
        bus.put(ODOM, payloads[-1])
    return payloads


class SimulatorSettings(RecorderSettings):
    """Any settings, under the simulator's name."""

    service = "simulator"


class DescribedSimulator(Service):
    """Answers the query for the world like a simulator."""

    name = "simulator"
    queries = (WORLD,)
    world = sessions.WORLD

    def on_request(self, query, request):
        return WorldReply(world=self.world, scanner=sessions.SCANNER, robot=Robot(radius=0.31))


@pytest.fixture
def simulator(bus) -> Iterator[DescribedSimulator]:
    service = DescribedSimulator(SimulatorSettings(robot=bus.robot))
    loop = ServiceLoop(service, bus, Inbox())
    thread = threading.Thread(target=loop.run)
    thread.start()
    yield service
    loop.stop()
    thread.join(20)
