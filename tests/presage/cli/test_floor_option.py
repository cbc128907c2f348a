"""The option --floor of the commands that take a place."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from common.errors import UserError
from presage.cli.main import app
from presage.live import commands


@pytest.fixture
def sent(monkeypatch):
    """The arguments with which the commands were called."""
    calls = []
    for name in ("send_goal", "teleport", "relocalise"):
        monkeypatch.setattr(commands, name, lambda _, place, *__, **more: calls.append((place, more)) or 0)
    return calls


def run(*words):
    result = CliRunner().invoke(app, words)
    if isinstance(result.exception, UserError):
        raise result.exception
    return result.exit_code


def test_goal(sent):
    assert run("goal", "3", "-2", "--floor", "first") == 0
    assert run("goal", "3", "2") == 0
    assert [goal.map_id for goal, _ in sent] == ["first", ""]


@pytest.mark.parametrize("command", ["teleport", "relocalise"])
def test_place(sent, command):
    assert run(command, "3", "2", "90", "--floor", "first") == 0
    ((pose, more),) = sent
    assert (pose.x, more["floor"]) == (3, "first")


def test_floor_without_a_position(sent):
    with pytest.raises(UserError, match="--floor needs a position"):
        run("relocalise", "--floor", "first")
    assert not sent
