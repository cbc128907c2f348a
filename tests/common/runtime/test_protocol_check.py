"""Services of different protocols or versions, as real processes."""

from __future__ import annotations

import platform
import signal
import threading
from pathlib import Path

import pytest

from common.bus.bus import open_bus, wait_until
from common.bus.inbox import Answer, Call, Inbox
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


def said(name="x", protocol=PROTOCOL, uptime=0.0, **versions) -> ConfigReply:
    return ConfigReply(service=name, protocol=protocol, uptime=uptime, versions=versions)


def started_long_ago(small, bus):
    """Wait until the service is so old that a new one is clearly later."""
    assert wait_until(lambda: "small" in bus.alive(), WAIT_TIMEOUT_S), small.output
    pulses = Inbox()
    bus.subscribe(HEALTH, pulses, keep_all=True)
    wait_for_message(pulses, Health, lambda h: h.uptime > 1.5 * SIMULTANEOUS_START_S)


def test_a_later_service_with_another_protocol_does_not_start(process, bus):
    small = process(SMALL)
    started_long_ago(small, bus)
    foreign = process(FOREIGN, env={"FOREIGN_PROTOCOL": str(OTHER), "FOREIGN_PRESAGE": "9.9"})
    assert foreign.wait() == 2
    host = platform.node()
    *ready, line = foreign.output.splitlines()  # on a busy machine it may start, because no reply arrives in time
    assert all("ready" in each for each in ready)
    assert line.startswith(f"foreign: protocol {OTHER} here (presage 9.9 on {host}), protocol {PROTOCOL} in the small")
    assert line.endswith(
        f"on {host}): they would misread each other's messages; install the same version of presage on both"
    )
    assert "foreign" not in bus.alive()
    assert small.running
    assert small.stop()[0] == 0
    assert "misread" not in small.output


class LateBus:
    """Fake bus with a link, on which the first queries reach no service, as after opening a session."""

    def __init__(self, found_nobody, other):
        self.found_nobody, self.other = found_nobody, other

    def linked(self):
        return True

    def ask_each(self, query, _request, inbox, _timeout):
        if self.found_nobody:
            self.found_nobody -= 1
        else:
            inbox.put(Answer(query, 0, self.other.encode()))
        done = threading.Event()
        done.set()
        return done


def test_queries_at_the_start_are_repeated():
    bus = LateBus(2, said("small", OTHER))
    with pytest.raises(UserError, match=f"protocol {OTHER} in the small"):
        ProtocolCheck(bus, "foreign", logger("foreign")).check_at_start(said("foreign"))


def test_a_later_service_ends_when_a_busy_one_replies(process, bus):
    small = process(SMALL)
    started_long_ago(small, bus)
    small.send(signal.SIGSTOP)  # it cannot reply
    foreign = process(FOREIGN, env={"FOREIGN_PROTOCOL": str(OTHER)})
    foreign.wait_for("ready")
    small.send(signal.SIGCONT)
    assert foreign.wait() == 2
    assert f"protocol {PROTOCOL} in the small" in foreign.output.splitlines()[-1]
    assert small.running


def test_an_earlier_service_logs_an_error_and_continues(process, bus, link):
    small = process(SMALL)
    assert wait_until(lambda: "small" in bus.alive(), WAIT_TIMEOUT_S), small.output
    calls = Inbox()
    with open_bus(link) as newcomer:
        newcomer.serve(CONFIG, calls, "careless")
        newcomer.declare_alive("careless")
        call = calls.get(WAIT_TIMEOUT_S)
        assert isinstance(call, Call)
        call.reply(said("careless", OTHER).encode())
        small.wait_for(f"protocol {OTHER} in the careless")
    assert small.stop()[0] == 0
    assert small.output.count("careless") == 1


def test_other_versions_are_one_warning(process, bus):
    foreign = process(FOREIGN, env={"FOREIGN_PRESAGE": "9.9"})
    assert wait_until(lambda: "foreign" in bus.alive(), WAIT_TIMEOUT_S), foreign.output
    small = process(SMALL)
    small.wait_for("other versions in the foreign")
    small.wait_for("ready")
    inbox = Inbox()
    assert bus.ask_each(CONFIG, Request(), inbox).wait(WAIT_TIMEOUT_S)  # both have turned since
    replies = {answer.reply().service: answer.reply() for answer in iter(lambda: inbox.get(0), None)}
    assert replies["foreign"].versions["presage"] == "9.9"
    assert replies["small"].protocol == PROTOCOL
    assert 0 < replies["small"].uptime < replies["foreign"].uptime
    assert small.stop()[0] == foreign.stop()[0] == 0
    assert small.output.count("other versions") == 1
    assert "presage 9.9 there" not in foreign.output


def test_exactly_one_of_two_services_started_later():
    for apart in (
        0.0,
        SIMULTANEOUS_START_S / 2,
        -SIMULTANEOUS_START_S / 2,
        2 * SIMULTANEOUS_START_S,
        -2 * SIMULTANEOUS_START_S,
    ):
        one, two = said(protocol=1, uptime=10.0), said(protocol=2, uptime=10.0 + apart)
        assert started_later(one, two) != started_later(two, one)
    assert started_later(said(protocol=2, uptime=1.0), said(protocol=1, uptime=10.0))


def test_an_unknown_protocol_is_accepted():
    assert same_protocol(said(), said(protocol=0))
    assert not same_protocol(said(), said(protocol=OTHER))


def test_only_versions_that_both_state_are_compared():
    mine = said(presage="1", python="3.11")
    assert not describe_version_differences(mine, said(presage="1", python="3.10"))
    assert not describe_version_differences(mine, said())
    assert describe_version_differences(mine, said(presage="2")) == "presage 1 here, 2 there"


def test_the_reply_describes_the_service():
    reply = build_config_reply("x", "{}", 3.0)
    assert (reply.protocol, reply.host, reply.uptime) == (PROTOCOL, platform.node(), 3.0)
    assert reply.versions["presage"]


def test_ask_each_reaches_both_instances_of_a_service(link, bus):
    with open_bus(link) as one, open_bus(link) as two:
        inboxes = [Inbox(), Inbox()]
        for session, inbox in zip((one, two), inboxes, strict=True):
            session.serve(CONFIG, inbox, "twice")
        answers = Inbox()

        def asked() -> bool:
            done = bus.ask_each(CONFIG, Request(), answers, 1.0, "twice")
            calls = [inbox.get(2.0) for inbox in inboxes]
            for call in calls:
                if call is not None:
                    call.reply(build_config_reply("twice", "{}").encode())
            assert done.wait(WAIT_TIMEOUT_S)
            return None not in calls

        assert wait_until(asked, WAIT_TIMEOUT_S)
        assert len({answer.session for answer in iter(lambda: answers.get(0), None)}) == 2
    with pytest.raises(UserError, match="no service answers"):
        bus.ask(CONFIG, Request(), ConfigReply, timeout=0.1, service="nobody")
