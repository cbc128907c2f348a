"""Worlds and drives, which the tests of the simulator share."""

from __future__ import annotations

import functools

import numpy as np

from common.geometry.world import World, load_world
from common.messages.definitions import Twist
from common.robot.scanner import SCANNERS

SCANNER = SCANNERS["tim571"].with_beams(271)  # a third of the beams: faster, and harder for the obstacle stop
HALL = World(name="hall", boundary=[(0, 0), (8, 0), (8, 6), (0, 6)], start={"x": 2, "y": 3})
# Too narrow for two people to pass each other.
ALLEY = World(name="alley", boundary=[(0, 0), (16, 0), (16, 0.9), (0, 0.9)])
FORWARD = Twist(vx=1.0)
shipped = functools.cache(load_world)


def drive(simulation, twist, seconds):
    """Truths while the same twist is commanded at each scan."""
    return [truth for _, truth, _ in measurements(simulation, seconds, twist)]


def measurements(simulation, seconds, twist=None):
    """Odometry, truth and scan of each period."""
    found = []
    for _ in range(round(seconds * 15)):
        assert simulation.command(simulation.stamp_ns, twist or Twist())
        simulation.advance()
        found.append(simulation.observe())
    return found


def speed(truth) -> float:
    return float(np.hypot(truth.twist.vx, truth.twist.vy))


def contacts(truths) -> int:
    return sum(truth.contact for truth in truths)
