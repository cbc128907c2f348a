"""Latency, dead band and slip of the simulated base."""

from __future__ import annotations

import numpy as np
import pytest

from common.robot.robot import Robot
from services.simulator.actuator import Actuator

DT, FORWARDS = 0.01, np.array([0.1, 0.0, 0.0])


def actuator(slip=0.0, **robot) -> Actuator:
    return Actuator(Robot(acceleration=100.0, turn_acceleration=100.0, **robot), slip, np.random.default_rng(1))


def speeds(base, targets, steps=6) -> list[float]:
    moved = []
    for target in targets:
        base.set_target(target, at_once=False)
        moved += [float(base.step(DT)[1][0]) for _ in range(steps)]
    return moved


def test_latency():
    assert speeds(actuator(latency=0.04), [FORWARDS, 2 * FORWARDS]) == pytest.approx([0] * 4 + [0.1] * 6 + [0.2] * 2)
    assert speeds(actuator(latency=0.1), [FORWARDS, 2 * FORWARDS, FORWARDS]) == pytest.approx(
        [0] * 10 + [0.1] * 6 + [0.2] * 2
    )


def test_stop_at_once():
    base = actuator(latency=0.04)
    speeds(base, [FORWARDS])
    base.set_target(np.zeros(3), at_once=True)
    assert not base.step(DT)[1].any()


def test_dead_band():
    base = actuator(dead_band=0.02, turn_dead_band=0.05)
    base.set_target(np.array([0.012, 0.012, 0.06]), at_once=False)
    assert base.step(DT)[1].tolist() == [0, 0, 0.06]
    base.set_target(np.array([0.015, 0.015, 0.04]), at_once=False)
    assert base.step(DT)[1].tolist() == [0.015, 0.015, 0]


@pytest.mark.parametrize("drive", ["holonomic", "differential"])
def test_slip(drive):
    base, moved = actuator(0.05, drive=drive), []
    for _ in range(2000):
        base.set_target(np.array([0.2, 0.0, 0.3]), at_once=False)
        wheels, velocity = base.step(DT)
        assert wheels.tolist() == [0.2, 0.0, 0.3]
        moved.append(velocity)
    assert np.mean(moved, axis=0) == pytest.approx([0.19, 0, 0.285], rel=0.01)
    assert np.std(moved, axis=0)[[0, 2]].min() > 0.003
