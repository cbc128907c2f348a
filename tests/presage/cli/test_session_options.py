"""A command says which session it acts on, unless the user has chosen it."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from common.runtime.session_files import session_file
from presage.cli.main import app
from presage.live import commands

HERE = "tcp/127.0.0.1:7001"


@pytest.mark.parametrize(
    ("options", "command", "line"),
    [
        ([], ["goal", "1", "1"], f"using session {HERE}, robot truck\n"),
        (["--connect", HERE], ["goal", "1", "1"], ""),
        ([], ["doctor"], ""),  # it only reads
    ],
)
def test_session(monkeypatch, options, command, line):
    monkeypatch.setattr(commands, "send_goal", lambda *_, **__: 0)
    monkeypatch.setattr("presage.diagnosis.doctor.run_doctor", lambda *_, **__: 0)
    with session_file(HERE, ["truck"], None, {}):
        done = CliRunner(env={"PRESAGE_CONNECT": "", "PRESAGE_ROBOT": ""}).invoke(app, [*options, *command])
    assert (done.exit_code, done.stderr, done.stdout) == (0, line, "")


def test_no_session(monkeypatch):
    monkeypatch.setattr(commands, "send_goal", lambda *_, **__: 0)
    done = CliRunner(env={"PRESAGE_CONNECT": "", "PRESAGE_ROBOT": ""}).invoke(app, ["goal", "1", "1"])
    assert (done.exit_code, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("command", "place"),
    [
        (["experiment", "e1", "--seed", "3"], "experiment --seed ... e1"),
        (["echo", "belief", "--robot", "truck"], "--robot ... echo"),
    ],
)
def test_option_of_the_group_after_the_command(command, place):
    done = CliRunner(env={"COLUMNS": "200"}).invoke(app, command)
    assert done.exit_code == 2
    assert place in done.stderr
    other = CliRunner(env={"COLUMNS": "200"}).invoke(app, ["experiment", "e1", "--nonsense"])
    assert "stands before" not in other.stderr
