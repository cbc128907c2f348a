"""The docking experiment: random docks, and the numbers of a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Goal, Pose, Status, Truth, Twist
from lab.experiments.lockstep import RunTrace
from lab.navigation import docking
from services.controller.docking import LINE_LENGTH_M

GOAL = Goal(stamp_ns=0, pose=Pose(x=2.0, y=1.0, yaw=np.pi / 2), approach=np.pi / 2)


def final(x, y, yaw_deg, state="reached") -> dict:
    truth = Truth(stamp_ns=5_000_000_000, pose=Pose(x=x, y=y, yaw=np.deg2rad(yaw_deg)), twist=Twist())
    status = Status(stamp_ns=4_000_000_000, state=state, reason="why")
    return docking.measure(RunTrace([truth], [], {4_000_000_000: status}, ended_ns=4_000_000_000), GOAL)


@pytest.mark.parametrize("index", [0, 1])
def test_random_docks(index):
    task, approach = docking.draw_docking(docking.DockingJob(index, 3))
    line = np.array(task.goal) - np.linspace(0, LINE_LENGTH_M, 20)[:, None] * [np.cos(approach), np.sin(approach)]
    assert load_world("maze").clearance(line).min() > 0.27 + docking.LINE_CLEARANCE_M - 0.01
    goal = docking.DockingJob(index, 3).goal(task, approach)
    assert abs(se2.wrap(goal.pose.yaw - approach)) == pytest.approx(index * np.pi)


def test_errors_at_the_goal():
    row = final(2.001, 0.998, 90.25)
    assert (row["along_m"], row["across_m"]) == pytest.approx((-0.002, -0.001))
    assert (row["position_m"], row["heading_deg"]) == pytest.approx((np.sqrt(5) * 1e-3, 0.25))
    assert (row["docked"], row["seconds"]) == (True, 4.0)


def test_summary():
    rows = [final(2.0, 1.0, 90.0), final(2.0, 1.004, 90.0), final(2.0, 1.0, 90.6), final(2.0, 1.0, 90.0, "blocked")]
    found = docking.summarise([{"trial": k, **row} for k, row in enumerate(rows)])
    assert (found["docked"], found["reached"], found["trials"]) == (1, 3, 4)
    assert found["failures"] == ["trial 3: blocked: why"]
    table = docking.table({"holonomic": found})
    assert "| holonomic | 1/4 | 5 % to 70 % | 0.00; " in table


def test_arguments_of_the_services():
    task, approach = docking.draw_docking(docking.DockingJob(0, 3))
    run = replace(docking.DockingJob(0, 3), drive="differential", latency=0.1).lockstep_run(task, approach)
    assert ("--latency", "0.1") == run.controller[2:4] == run.simulator[2:4]
    assert "--slip" not in run.controller
