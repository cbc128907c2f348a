"""A building whose floors are ROS maps, with all services: a goal on another floor, by a lift."""

from __future__ import annotations

import signal
from itertools import pairwise

import pytest

from common.bus.bus import wait_until
from common.geometry.rasterisation import rasterise
from common.geometry.ros_map_writer import write_grid
from tests.common.geometry.maps import ROOM
from tests.conftest import WAIT_TIMEOUT_S
from tests.controller.driving import box, room

TOWER = """
floors: {ground: ground.yaml, first: first.yaml}
lifts: [{ground: [5, 3.5], first: [1, 2]}]
start: {floor: ground, x: 5, y: 4.3}
"""
SERVICES = ("simulator", "estimator", "controller")


@pytest.fixture
def tower(process, bus, link, tmp_path, monkeypatch):
    """All services in the building."""
    for name, world in {"ground": ROOM, "first": room(6, 4, box(4, 3.5, 1, 0.6))}.items():
        write_grid(tmp_path, name, rasterise(world))
    (tmp_path / "tower.yaml").write_text(TOWER)
    monkeypatch.setenv("PRESAGE_CONNECT", link.connect[0])
    monkeypatch.setenv("PRESAGE_ROBOT", link.robot)
    environment = {"PRESAGE_WORLD": str(tmp_path / "tower.yaml"), "PRESAGE_MODEL": "exact"}
    environment["PRESAGE_PACE"] = "lockstep"  # however slow the machine is
    for name in SERVICES:
        process(name, env=environment)
    assert wait_until(lambda: set(SERVICES) <= bus.alive(), WAIT_TIMEOUT_S)


@pytest.mark.usefixtures("tower")
def test_goal_on_another_floor(process, presage):
    going = process("presage.__main__", "goal", "2", "2", "--floor", "first", "--wait")
    going.wait_for("waiting to be taken to floor 'first'")
    for command, says in (
        ("teleport 4 3.5 --floor first", "(4.00, 3.50) on floor 'first' in tower is inside something"),
        ("teleport -3 3 --floor first", "(-3, 3) is not on floor 'first', which reaches from (-0.1, -0.1) to"),
        ("relocalise 1 2 --floor attic", "there is no floor 'attic': choose one of ground, first"),
    ):
        status, output = presage(*command.split())
        assert (status, says in output) == (2, True), output
    assert presage("teleport", "1", "2", "0", "--floor", "first")[0] == 0
    assert going.wait() == 0, going.output
    assert going.output.startswith("going to (2, 2) on floor 'first'\n")
    assert going.output.splitlines()[-1].startswith("reached: within 0.02 m of the goal")
    lines = going.output.splitlines()
    assert len(set(lines)) < 12
    assert all(before != after for before, after in pairwise(lines))  # only changes are printed

    status, output = presage("goal", "4", "3.5", "--floor", "first")
    assert status == 2
    assert "goal refused: (4.00, 3.50) on floor 'first' in tower is inside something" in output
    waiting = process("presage.__main__", "goal", "5", "4", "--floor", "ground", "--wait")
    waiting.wait_for("waiting to be taken to floor 'ground'")
    assert waiting.stop(signal.SIGINT) == 130
    assert "the robot keeps its goal; `presage goal --cancel` stops it" in waiting.output
    assert presage("goal", "--cancel") == (0, "cancelled; the robot stops\n")
