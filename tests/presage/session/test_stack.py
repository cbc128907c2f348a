"""Signals that end a command, and a session that starts slowly."""

from __future__ import annotations

import os
import signal

import pytest

from presage.interrupts import deferring_interrupts, interruptible
from presage.session import stack


@pytest.fixture
def restored():
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("restored")
@pytest.mark.parametrize(
    ("number", "before", "ends"),
    [
        (signal.SIGTERM, signal.SIG_DFL, True),
        (signal.SIGHUP, signal.SIG_DFL, True),
        (signal.SIGHUP, signal.SIG_IGN, False),  # as under nohup
        (signal.SIGINT, signal.SIG_IGN, True),  # as in the background of a script
    ],
)
def test_signals(number, before, ends):
    signal.signal(number, before)
    ended = False
    try:
        with interruptible():
            os.kill(os.getpid(), number)
    except KeyboardInterrupt:
        ended = True
    assert ended == ends
    assert signal.getsignal(number) == before


@pytest.mark.usefixtures("restored")
def test_interrupts_while_a_process_starts():
    """They end the command, but not before the process is known."""
    steps = []
    try:
        with interruptible(), deferring_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
            steps.append("process started")
        steps.append("command continued")
    except KeyboardInterrupt:
        steps.append("interrupted")
    assert steps == ["process started", "interrupted"]


def test_slow_start_is_explained(monkeypatch, capsys):
    monkeypatch.setattr(stack, "SLOW_START_S", 0.0)
    answers = iter([{"estimator"}, {"estimator"}, {"estimator"}, set()])
    monkeypatch.setattr(stack.Stack, "_missing", lambda *_: next(answers))
    made = stack.Stack.__new__(stack.Stack)
    made.processes = {}
    made.wait_alive(None)
    assert capsys.readouterr().err == (
        "waiting for estimator: the first start compiles code, which can take half a minute\n"
    )


def test_restart_command_has_a_placeholder_for_secrets():
    settings = {"PRESAGE_ROBOT": "my robot", "PRESAGE_VIEWER_TOKEN": "tea"}
    process = stack.ServiceProcess("viewer", None, None, args=["-m", "services.viewer"], settings=settings)
    assert process.restart_command == "PRESAGE_ROBOT='my robot' PRESAGE_VIEWER_TOKEN=... python -m services.viewer"
