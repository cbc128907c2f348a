"""The inbox compared with a simple model of it."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections import Counter

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from common.bus.inbox import MAX_KEYS, Inbox, IncomingRequest, RequestResult, Sample
from common.messages.requests import Reply
from common.messages.topics import HEALTH, MAX_BYTES, SCAN, TELEPORT
from tests.conftest import ROOT


def sample(key="a", payload=b"", topic=SCAN) -> Sample:
    return Sample(topic, key, payload, 0, 0)


class Model(RuleBasedStateMachine):
    """Model of the inbox: a list that is searched."""

    CAPACITY, BYTES = 4, 100

    def __init__(self):
        super().__init__()
        self.inbox = Inbox(self.CAPACITY, self.BYTES)
        self.queue: list[tuple[bool, Sample]] = []
        self.received, self.dropped = Counter(), Counter()

    @rule(key=st.sampled_from("ab"), size=st.integers(0, 60), newest=st.booleans())
    def put(self, key, size, newest):
        key = key if newest else key.upper()  # one policy a key
        entry = sample(key, bytes(size))
        self.inbox.put(entry, newest_only=newest)
        self.received[key] += 1
        held = sum(len(e.payload) for _, e in self.queue)
        for i, (was_newest, old) in enumerate(self.queue):
            if newest and was_newest and old.key == key:
                self.queue[i] = (True, entry)
                self.dropped[key] += 1
                return
        if len(self.queue) >= self.CAPACITY or held + size > self.BYTES:
            self.dropped[key] += 1
        else:
            self.queue.append((newest, entry))

    @rule()
    def get(self):
        expected = self.queue.pop(0)[1] if self.queue else None
        assert self.inbox.get(0) is expected

    @invariant()
    def counts(self):
        assert len(self.inbox) == len(self.queue)
        assert self.inbox.received == self.received
        assert self.inbox.dropped == self.dropped


TestModel = Model.TestCase
TestModel.settings = settings(max_examples=100, stateful_step_count=30)


def test_a_busy_key_does_not_displace_another():
    inbox = Inbox(capacity=2)
    inbox.put(sample("goal", b"here"), newest_only=True)
    for _ in range(1000):
        inbox.put(sample("scan"), newest_only=True)
    assert inbox.get(0).payload == b"here"


def test_samples_of_several_sources():
    inbox = Inbox()
    for number in range(3):
        for source in ("robot", "repeater"):
            inbox.put(Sample(SCAN, "k", f"{source} {number}".encode(), 0, 0, source), newest_only=True)
    assert [inbox.get(0).payload for _ in range(2)] == [b"robot 2", b"repeater 2"]
    assert inbox.get(0) is None


def test_oversized_payloads():
    inbox, refused = Inbox(), []
    for size in (MAX_BYTES, MAX_BYTES + 1):
        inbox.put(sample("scan", bytes(size)))
    inbox.put(IncomingRequest(TELEPORT, bytes(64 * MAX_BYTES + 1), lambda _: None, refused.append))
    assert (len(inbox), len(refused)) == (1, 1)
    assert inbox.oversized == {"scan": 1, "teleport": 1}
    assert inbox.received == {"scan": 2, "teleport": 1}


def test_full_queues():
    inbox, refused = Inbox(capacity=1), []
    for _ in range(2):
        inbox.put(IncomingRequest(TELEPORT, b"", lambda _: None, refused.append))
    assert refused == ["too many requests are waiting"]
    inbox.put(RequestResult(TELEPORT, 7, Reply(reason="here").encode()))
    inbox.put(RequestResult(TELEPORT, 8, bytes(64 * MAX_BYTES + 1)))
    _, answer, large = (inbox.get(0) for _ in range(3))
    assert answer.reply() == Reply(reason="here")
    assert (large.number, large.payload) == (8, b"")
    assert large.reply() == Reply(ok=False, reason=f"the reply of {64 * MAX_BYTES + 1} bytes is too large")


def test_undecodable_answers():
    reply = RequestResult(TELEPORT, 1, b"\xc1").reply()
    assert not reply.ok
    assert "cannot be decoded" in reply.reason


def test_invented_keys_do_not_fill_memory():
    inbox = Inbox()
    for i in range(3 * MAX_KEYS):
        inbox.put(sample(f"presage/robot/health/{i}", topic=HEALTH))
    inbox.put(sample("presage/robot/health/0", topic=HEALTH))
    assert len(inbox.received) == MAX_KEYS + 1
    assert inbox.received["others"] == 2 * MAX_KEYS
    assert inbox.received["presage/robot/health/0"] == 2


def test_get_waits_for_an_entry_or_a_wake():
    inbox = Inbox()
    began = time.monotonic()
    assert inbox.get(0.05) is None
    assert time.monotonic() - began > 0.04
    threading.Timer(0.05, lambda: inbox.put(sample("late"))).start()
    assert inbox.get(30).key == "late"
    threading.Timer(0.05, inbox.wake).start()
    assert inbox.get(30) is None
    assert time.monotonic() - began < 15


INTERRUPTED = """
import signal, threading, time
from common.bus.inbox import Inbox, Sample
from common.messages.topics import SCAN

signal.signal(signal.SIGALRM, signal.default_int_handler)
for number in range(100):
    inbox, putting = Inbox(), True

    def put():
        while putting:
            inbox.put(Sample(SCAN, "key", b"", 0, 0), newest_only=True)

    thread = threading.Thread(target=put, daemon=True)
    thread.start()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.0005 + number * 4e-5)
        while True:
            inbox.get(0.001)
    except (KeyboardInterrupt, RuntimeError):  # the second inside Condition.wait, in the moment before it waits
        putting = False
    thread.join(10)
    assert not thread.is_alive(), "locked for ever"
"""


def test_interrupted_inbox():
    """Otherwise zenoh's threads would wait for the lock, and the session could never close."""
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_many_threads():
    inbox = Inbox(capacity=50)
    threads = [
        threading.Thread(target=lambda k=k: [inbox.put(sample(k), newest_only=k == "0") for _ in range(2000)])
        for k in "0123"
    ]
    for thread in threads:
        thread.start()
    got = 0
    while any(t.is_alive() for t in threads) or len(inbox):
        got += inbox.get(0.01) is not None
    for thread in threads:
        thread.join()
    assert sum(inbox.received.values()) == 8000
    assert got + sum(inbox.dropped.values()) == 8000
