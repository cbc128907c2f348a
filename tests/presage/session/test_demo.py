"""The goal that `presage demo` chooses."""

from __future__ import annotations

import pytest

from common.errors import UserError
from common.geometry.world import World
from presage.session.demo import DemoOptions, _choose_goal
from tests.common.geometry.maps import building

ROOM = World(name="room", boundary=[(0, 0), (6, 0), (6, 4), (0, 4)], start={"x": 1, "y": 1})
SHORT = World(name="short", boundary=[(0, 0), (4, 0), (4, 4), (0, 4)])


@pytest.mark.parametrize("seed", range(3))
def test_goal_on_the_floor_of_the_start(seed):
    tower = building(ground=ROOM, first=SHORT)
    assert tower.floor_at(_choose_goal(DemoOptions(seed=seed), tower)).name == "ground"


def test_goal_in_a_wall():
    with pytest.raises(UserError, match=r"goal \(3.00, 3.95\) in room .*; the nearest place .* is \(.*\) \(--goal\)"):
        _choose_goal(DemoOptions(goal=(3.0, 3.95)), ROOM)
