"""`presage up` refuses what its services would refuse, before it starts any."""

from __future__ import annotations

import pytest

from common.errors import UserError
from presage.session import up
from presage.terminal.options import console


@pytest.fixture
def nothing_starts(monkeypatch):
    def start(*_, **__):
        raise AssertionError("a process would be started")

    monkeypatch.setattr(up, "Stack", start)


@pytest.mark.usefixtures("nothing_starts")
@pytest.mark.parametrize(
    ("arguments", "variables", "says"),
    [
        (["--learn", "refine"], {}, "--learn is for one robot"),
        ([], {"PRESAGE_INITIAL_POSE": "3,1.5,0"}, "initial_pose is for one robot"),
        ([], {"PRESAGE_ESTIMATOR_MAX_ROBOTS": "1"}, "2 robots are named"),
        ([], {"PRESAGE_ROBOT": "x" * 64}, "of up to 64 letters"),  # with its number, it is too long
    ],
)
def test_two_robots(monkeypatch, arguments, variables, says):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(UserError, match=says):
        up.run_up(up.UpOptions(estimator=arguments, robots=2), console)


@pytest.mark.usefixtures("nothing_starts")
@pytest.mark.parametrize("arguments", [["--learn", "refine"], ["--estimator", "paper"], ["--model", "exact"]])
def test_options_of_the_estimator_while_mapping(arguments):
    with pytest.raises(UserError, match="--mapping runs no estimator"):
        up.run_up(up.UpOptions(estimator=arguments, mapping=True), console)
