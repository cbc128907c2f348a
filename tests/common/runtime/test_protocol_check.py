"""Services of different protocols or versions, as real processes."""

from __future__ import annotations

import platform
import signal
import threading
from pathlib import Path

import pytest

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Inbox, IncomingRequest, RequestResult
from common.errors import UserError
from common.log import logger
from common.messages.definitions import Health
from common.messages.requests import ConfigReply, Request
from common.messages.topics import CONFIG, HEALTH
from common.runtime.protocol_check import (
    SIMULTANEOUS_START_S,
    ProtocolCheck,
    build_config_reply,
    describe_version_differences,
    same_protocol,
    started_later,
)
from common.versions import PROTOCOL
from tests.conftest import WAIT_TIMEOUT_S, wait_for_message

SMALL = Path(__file__).parents[1] / "small_service.py"
FOREIGN = Path(__file__).parents[1] / "foreign_service.py"
OTHER = PROTOCOL + 1


def reply_of(name="x", protocol=PROTOCOL, uptime=0.0, **versions) -> ConfigReply:
    return ConfigReply(service=name, protocol=protocol, uptime=uptime, versions=versions)


def started_long_ago(small, bus):
    """Waits until the service is so old that a new one is clearly later."""
    assert wait_until(lambda: "small" in bus.alive(), WAIT_TIMEOUT_S), small.output
    messages = Inbox()
    bus.subscribe(HEALTH, messages, keep_all=True)
    wait_for_message(messages, Health, lambda h: h.uptime > 1.5 * SIMULTANEOUS_START_S)


def test_later_service_with_another_protocol(process, bus):
    small = process(SMALL)
    started_long_ago(small, bus)
    foreign = process(FOREIGN, env={"FOREIGN_PROTOCOL": str(OTHER), "FOREIGN_PRESAGE": "9.9"}, fresh=True)
    assert foreign.wait() == 2
    host = platform.node()
    *ready, line = foreign.output.splitlines()  # on a busy machine it may start, because no reply arrives in time
    assert all("ready" in each for each in ready)
    assert line.startswith(f"foreign: protocol {OTHER} here (presage 9.9 on {host}), protocol {PROTOCOL} in the small")
    assert line.endswith("install the same version of presage on both")
    assert "foreign" not in bus.alive()
    assert small.running
    assert small.stop() == 0
    assert "misread" not in small.output


class LateBus:
    """Fake bus with a link, on which the first queries reach no service, as after opening a session."""

    def __init__(self, unanswered, other):
        self.unanswered, self.other = unanswered, other

    def linked(self):
        return True

    def query_all(self, query, _request, inbox, _timeout):
        if self.unanswered:
            self.unanswered -= 1
        else:
            inbox.put(RequestResult(query, 0, self.other.encode()))
        done = threading.Event()
        done.set()
        return done


def test_queries_at_the_start_are_repeated():
    bus = LateBus(2, reply_of("small", OTHER))
    with pytest.raises(UserError, match=f"protocol {OTHER} in the small"):
        ProtocolCheck(bus, "foreign", logger("foreign")).check_at_start(reply_of("foreign"))


def test_late_reply_of_a_busy_service(process, bus):
    small = process(SMALL)
    started_long_ago(small, bus)
    small.send(signal.SIGSTOP)  # it cannot reply
    foreign = process(FOREIGN, env={"FOREIGN_PROTOCOL": str(OTHER)}, fresh=True)
    foreign.wait_for("ready")
    small.send(signal.SIGCONT)
    assert foreign.wait() == 2
    assert f"protocol {PROTOCOL} in the small" in foreign.output.splitlines()[-1]
    assert small.running


def test_earlier_service_continues(process, bus, link):
    small = process(SMALL)
    started_long_ago(small, bus)
    calls = Inbox()
    with open_bus(link) as newcomer:
        newcomer.serve(CONFIG, calls, "careless")
        newcomer.declare_alive("careless")
        call = calls.get(WAIT_TIMEOUT_S)
        assert isinstance(call, IncomingRequest)
        call.reply(reply_of("careless", OTHER).encode())
        small.wait_for(f"protocol {OTHER} in the careless")
    assert small.stop() == 0
    assert small.output.count("careless") == 1


def test_other_versions_are_one_warning(process, bus):
    foreign = process(FOREIGN, env={"FOREIGN_PRESAGE": "9.9"}, fresh=True)
    assert wait_until(lambda: "foreign" in bus.alive(), WAIT_TIMEOUT_S), foreign.output
    small = process(SMALL)
    small.wait_for("other versions in the foreign")
    small.wait_for("ready")
    inbox = Inbox()
    assert bus.query_all(CONFIG, Request(), inbox).wait(WAIT_TIMEOUT_S)  # both have turned since
    replies = {answer.reply().service: answer.reply() for answer in iter(lambda: inbox.get(0), None)}
    assert replies["foreign"].versions["presage"] == "9.9"
    assert replies["small"].protocol == PROTOCOL
    assert 0 < replies["small"].uptime < replies["foreign"].uptime
    assert small.stop() == foreign.stop() == 0
    assert small.output.count("other versions") == 1
    assert "presage 9.9 there" not in foreign.output


@pytest.mark.parametrize("difference", [0.0, 0.5, -0.5, 2.0, -2.0])
def test_two_later_services(difference):
    one = reply_of(protocol=1, uptime=10.0)
    two = reply_of(protocol=2, uptime=10.0 + difference * SIMULTANEOUS_START_S)
    assert started_later(one, two) != started_later(two, one)
    if abs(difference) > 1:
        assert started_later(one, two) == (difference > 0)


def test_comparison_of_replies():
    mine = reply_of(presage="1", python="3.11")
    assert same_protocol(mine, reply_of(protocol=0))  # unknown
    assert not same_protocol(mine, reply_of(protocol=OTHER))
    assert not describe_version_differences(mine, reply_of(presage="1", python="3.10"))
    assert not describe_version_differences(mine, reply_of())
    assert describe_version_differences(mine, reply_of(presage="2")) == "presage 1 here, 2 there"


def test_both_instances_answer(link, bus):
    with open_bus(link) as one, open_bus(link) as two:
        inboxes = [Inbox(), Inbox()]
        for session, inbox in zip((one, two), inboxes, strict=True):
            session.serve(CONFIG, inbox, "twice")
        answers = Inbox()

        def both_received() -> bool:
            done = bus.query_all(CONFIG, Request(), answers, 1.0, "twice")
            calls = [inbox.get(2.0) for inbox in inboxes]
            for call in calls:
                if call is not None:
                    call.reply(build_config_reply("twice", "{}").encode())
            assert done.wait(WAIT_TIMEOUT_S)
            return None not in calls

        assert wait_until(both_received, WAIT_TIMEOUT_S)
        assert len({answer.session for answer in iter(lambda: answers.get(0), None)}) == 2
    with pytest.raises(UserError, match="no service answers"):
        bus.query(CONFIG, Request(), ConfigReply, timeout=0.1, service="none")
