"""A whole exploration of two rooms in one process, the baseline, and the table of results."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.coverage import reachable_area
from common.geometry.world import World
from common.robot.robot import Robot
from lab.exploration.drive import explore, measure
from lab.exploration.experiment import EXPLORERS, summarise, table
from lab.exploration.nearest_frontier import nearest_frontier
from services.controller.policies.exploration import choose_viewpoint
from tests.controller.policies.test_exploration import CLOSED, CROSSROADS, exploration_state_of

# A room, and behind a wall with a door another one that cannot be seen from the start.
ROOMS = World(
    name="rooms",
    boundary=[(0, 0), (7, 0), (7, 4), (0, 4)],
    obstacles=[{"box": {"center": (4, 1.3), "size": (0.2, 2.6)}}, {"box": {"center": (1, 3.7), "size": (0.8, 0.4)}}],
)
START = np.array([1.5, 1.0, np.pi])


def test_two_rooms_are_explored():
    run = explore(ROOMS, Robot(), choose_viewpoint, START, seed=1, limit_s=120.0, beams=207)
    row = measure(run, ROOMS, Robot())
    assert row["phase"] == "finished", row["reason"]
    assert row["mapped_share"] > 0.95
    assert row["return_error_m"] < 0.05
    assert row["contact_scans"] == 0
    assert 4.0 < row["path_m"] < 40.0


def test_the_baseline_drives_to_the_nearest_frontier():
    state = exploration_state_of(CROSSROADS, pose=(2.8, 2.0, 0.0))
    viewpoint = nearest_frontier(state)
    assert viewpoint is not None
    assert viewpoint.pose[1] > 2.4  # the way up and left is shorter than that down and right
    assert nearest_frontier(exploration_state_of(CLOSED)) is None


def test_reachable_area():
    assert reachable_area(ROOMS, 0.27, START).area == pytest.approx(28 - 0.52 - 0.32, abs=0.5)
    shut = ROOMS.with_obstacles([*ROOMS.obstacles, {"box": {"center": (4, 3.3), "size": (0.2, 1.4)}}])
    assert reachable_area(World.model_validate(shut.model_dump()), 0.27, START).area < 16


def test_table_of_all_trials():
    row = {
        "phase": "finished",
        "mapped_share": 0.97,
        "mapped_share_tight": 0.96,
        "return_error_m": 0.01,
        "contact_scans": 0,
        "seconds": 60.0,
    }
    rows = [row | {"explorer": name, "path_m": path} for name, path in zip(EXPLORERS, (30.0, 40.0), strict=True)]
    summary = summarise([*rows, *(each | {"contact_scans": 2, "path_m": 20.0} for each in rows)])
    assert summary["presage"]["max_path_ratio"] == 1.0
    assert summary["presage"]["trials_with_contact"] == 1
    assert "| presage | 2/2 | 2/2 | 97.0; 97.0 | 2/2 | 10.0; 10.0 | 1 | 50 | 0.88; 1.00 | 120 |" in table(summary)
