"""Arguments that are numbers, perhaps negative, and mistakes beside them."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from common.errors import UserError
from presage.cli.main import app
from presage.live import commands


def run(*words):
    result = CliRunner().invoke(app, words, prog_name="presage")
    if isinstance(result.exception, UserError):
        raise result.exception
    return result


def test_negative_numbers(monkeypatch):
    sent = []
    monkeypatch.setattr(commands, "send_goal", lambda _, goal, *__, **___: sent.append(goal) or 0)
    assert run("goal", "-1.5", "-2", "--tolerance", "0.1").exit_code == 0
    assert (sent[0].pose.x, sent[0].pose.y, sent[0].tolerance) == (-1.5, -2.0, 0.1)


def test_not_a_number():
    result = run("goal", "15,1.5")
    assert result.exit_code == 2
    assert "'15,1.5' is not a number; separate numbers by spaces" in " ".join(result.output.replace("│", " ").split())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("goal 15 1.5 --tolerence 0.1", "goal has no option --tolerence; did you mean --tolerance?"),
        ("obstacle add crate 6 -1 --radios=0.2", "add has no option --radios; did you mean --radius?"),
        ("goal 15 1.5 --xyz", "presage goal --help lists all"),
        ("goal 15 1.5 --robot two", "--robot stands before the command, as in presage --robot NAME goal"),
        ("obstacle add a 1 2 --foo 3", "; presage obstacle add --help lists all"),
        ("obstacle add a 1 2 --robot two", "as in presage --robot NAME obstacle add"),
        ("goal --cancel 3 3", "--cancel cancels the current goal, whichever it is: leave out the place"),
    ],
)
def test_mistakes(words, says):
    with pytest.raises(UserError) as error:
        run(*words.split())
    assert says in str(error.value)
