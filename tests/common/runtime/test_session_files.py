"""The command that starts a missing service, and which services a session was started without."""

from __future__ import annotations

import pytest

from common.bus.bus import DEFAULT_ENDPOINT
from common.runtime.session_files import is_left_out, session_file, session_of, start_command

ELSEWHERE = "tcp/127.0.0.1:7001"
COMMANDS = {
    "simulator": "python -m services.simulator --world=office",
    "estimator": "python -m services.estimator --world=office --estimator=particle-filter",
    "two/simulator": "python -m services.simulator --robot two --world=office",
}


def command_of(service, robot, connect=""):
    return start_command(service, robot, connect, session_of(robot, connect))


@pytest.mark.parametrize(
    ("service", "robot", "connect", "command"),
    [
        ("estimator", "robot", "", "python -m services.estimator  # add --world and --estimator of the session"),
        ("router", "robot", "tcp/a:7447", "python -m common.router"),
        ("viewer", "two", "tcp/a:7447", "python -m services.viewer --robot two --connect tcp/a:7447"),
    ],
)
def test_start_commands_without_a_session(service, robot, connect, command):
    assert command_of(service, robot, connect) == command
    assert not is_left_out(service, robot, session_of(robot, connect))


def test_start_commands_of_a_session():
    with session_file(ELSEWHERE, ["one", "two"], None, COMMANDS):
        assert command_of("estimator", "two", ELSEWHERE) == COMMANDS["estimator"]  # one for both robots
        assert command_of("simulator", "one", ELSEWHERE) == COMMANDS["simulator"]
        assert command_of("simulator", "two", ELSEWHERE) == COMMANDS["two/simulator"]
        other = [("simulator", "one", ""), ("simulator", "three", ELSEWHERE), ("mapper", "one", ELSEWHERE)]
        assert not {command_of(*each) for each in other} & set(COMMANDS.values())
        session = session_of("one", ELSEWHERE)
        assert [is_left_out(name, "one", session) for name in ("viewer", "estimator")] == [True, False]
    with session_file(DEFAULT_ENDPOINT, ["one"], None, COMMANDS):
        assert command_of("simulator", "one") == COMMANDS["simulator"]
