"""A running system survives malformed payloads on every key."""

from __future__ import annotations

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.messages.definitions import Health, Scan, Truth
from common.messages.requests import ConfigReply, Request
from common.messages.topics import CONFIG, HEALTH, MAX_BYTES, QUERIES, SCAN, TOPICS, TRUTH
from common.messages.wire import DecodeError
from services.recorder.reader import read_recording
from tests.common.samples import message_of
from tests.conftest import WAIT_TIMEOUT_S

SERVICES = ("simulator", "estimator", "controller", "recorder")
EXAMPLES = 40  # per key
SUBSCRIBED_TOPICS = {
    "simulator": ["cmd_vel"],
    "estimator": ["scan", "goal"],
    "controller": ["scan", "belief", "goal", "drive"],
}

ARBITRARY_VALUES = st.one_of(
    st.none(),
    st.sampled_from(
        [float("nan"), float("inf"), float("-inf"), -1, 2**63, 2**64 - 1, "", "x" * 300, True, b"", b"\x00" * 7]
    ),
    st.binary(max_size=40),
    st.lists(st.floats(), max_size=4),
    st.dictionaries(st.text(max_size=5), st.floats(), max_size=3),
)


def decodes(cls, payload) -> bool:
    try:
        cls.decode(payload)
    except DecodeError:
        return False
    return True


def malformed_payloads(cls):
    """Strategy for payloads that are no valid message of the class: random bytes, and damaged valid messages."""
    whole = message_of(cls).map(lambda message: message.encode())
    fields = whole.map(msgpack.unpackb).filter(bool)
    replaced = st.tuples(fields, st.randoms(use_true_random=False), ARBITRARY_VALUES).map(
        lambda parts: msgpack.packb({**parts[0], parts[1].choice(sorted(parts[0])): parts[2]})
    )
    without = fields.map(lambda values: msgpack.packb(dict(list(values.items())[1:])))
    cut = st.tuples(whole, st.floats(0, 0.99)).map(lambda parts: parts[0][: int(len(parts[0]) * parts[1])])
    flipped = st.tuples(whole, st.integers(0, 2**30), st.integers(1, 255)).map(
        lambda p: bytes(b ^ (p[2] if i == p[1] % len(p[0]) else 0) for i, b in enumerate(p[0]))
    )
    nested = st.integers(1, 3000).map(lambda depth: b"\x91" * depth)
    claimed = st.sampled_from(
        [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\x7f\xff\xff\xff"]
    )
    kinds = [st.binary(max_size=200), nested, claimed, cut, flipped]
    kinds += [replaced, without] if cls.model_fields else []
    return st.one_of(kinds).filter(lambda payload: not decodes(cls, payload))


@pytest.fixture(scope="module")
def system(module_processes, router):
    """A session, the four running services, and the folder of the recording."""
    link = Link(robot="hostile", connect=(f"tcp/127.0.0.1:{router}",))
    folder = module_processes.folder
    environment = {"PRESAGE_CONNECT": link.connect[0], "PRESAGE_ROBOT": link.robot, "PRESAGE_DIRECTORY": str(folder)}
    with open_bus(link) as bus:
        running = {name: module_processes.start(name, env=environment) for name in SERVICES}
        assert wait_until(lambda: set(SERVICES) <= bus.alive(), WAIT_TIMEOUT_S)
        yield bus, running, folder


def next_message(bus, topic, kind, condition=lambda _: True):
    """Waits for a message from now on that meets the condition, and returns it."""
    inbox, found = Inbox(), []
    bus.subscribe(topic, inbox, keep_all=True)

    def check():
        while isinstance(sample := inbox.get(0), Sample):
            if decodes(kind, sample.payload) and condition(message := kind.decode(sample.payload)):
                found.append(message)
        return bool(found)

    assert wait_until(check, WAIT_TIMEOUT_S), f"no {kind.__name__}"
    return found[-1]


@pytest.fixture(scope="module")
def before(system):
    """The robot's true state before the first malformed payload."""
    return next_message(system[0], TRUTH, Truth)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_payloads(system, before, topic):
    bus, running, _ = system

    @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
    @given(malformed_payloads(topic.message))
    def send(payload):
        bus.put(topic, payload, service="intruder")

    send()
    for oversized in (b"\x00" * (MAX_BYTES + 1), b"\xc1" * (4 * MAX_BYTES)):
        bus.put(topic, oversized, service="intruder")
    assert all(process.running for process in running.values())


# The player answers only while a replay runs: tests/recorder/replaying/test_replay.py has its hostile requests.
ANSWERED = [query for query in QUERIES if query.server in (*SERVICES, "every service")]


@pytest.mark.parametrize("query", ANSWERED, ids=lambda query: query.name)
def test_requests(system, before, query):
    bus, running, _ = system
    service = "estimator" if query is CONFIG else "*"

    @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
    @given(malformed_payloads(query.request))
    def ask(payload):
        (answer,) = bus._session.get(query.key(bus.robot, service), payload=payload, timeout=WAIT_TIMEOUT_S)
        assert answer.err is not None
        assert query.request.__name__ in answer.err.payload.to_string()

    ask()
    assert all(process.running for process in running.values())


def test_afterwards(system, before):
    """The robot has not moved, all services answer, and have counted, logged and recorded what they received."""
    bus, running, folder = system
    after = next_message(bus, TRUTH, Truth, lambda truth: truth.stamp_ns > before.stamp_ns + 10**9)
    assert after.pose.array() == pytest.approx(before.pose.array(), abs=1e-3)
    first = next_message(bus, SCAN, Scan)
    assert next_message(bus, SCAN, Scan, lambda scan: scan.seq > first.seq + 5)
    for name in SERVICES:
        assert bus.query(CONFIG, Request(), ConfigReply, service=name, timeout=WAIT_TIMEOUT_S).service == name
        assert "Traceback" not in running[name].output, running[name].output[-3000:]
    for name, topics in SUBSCRIBED_TOPICS.items():
        health = next_message(bus, HEALTH, Health, lambda h, n=name: h.service == n)
        rows = {row.key: row for row in health.topics}
        for topic in topics:
            row = rows[f"presage/hostile/{topic}"]
            assert row.received >= EXAMPLES
            assert row.undecodable > 0
        assert health.counters["failed"] == 0
        assert 0 < running[name].output.count("payload dropped") < EXAMPLES  # at most once per second and key
    assert running["recorder"].stop() == 0
    (file,) = folder.glob("*.mcap")
    counts = read_recording(file).counts
    for topic in TOPICS:
        assert counts[topic.key(bus.robot, "intruder")] >= EXAMPLES, topic.name
