"""Two identical rooms: both hypotheses are kept until the corridor is seen, without odometry."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory

TWIN = np.array([6.0, 0.0, 0.0])
WORLD = load_world("twins")
RATE = 15.0


def begun(model, seed):
    scene = Scene.of(WORLD, 622, seed)
    scanner = scene.scanner
    geometry = ScannerGeometry(scanner.angles(), np.array(scanner.mount), scanner.range_max)
    made = prepare_factory(EstimatorOptions("twins", model=model))(geometry)
    return made, scene


def drive(start, *corners, speed=0.8):
    """Poses (N, 3), one per scan, with the heading of the start."""
    points = np.array([start[:2], *corners])
    legs = [np.linspace(a, b, int(np.hypot(*(b - a)) / speed * RATE)) for a, b in pairwise(points)]
    places = np.concatenate(legs)
    return np.column_stack([places, np.full(len(places), start[2])])


# The errors of the field differ a little between the rooms.
@pytest.mark.parametrize(("model", "most"), [("learned", 0.85), ("exact", 0.55)])
@pytest.mark.parametrize(("room", "yaw"), [(0, 0.0), (1, 2.0)])
def test_two_rooms(model, most, room, yaw):
    made, scene = begun(model, 10 * room + int(yaw))
    start = np.array([2.0, 2.2, yaw])
    stands = np.tile(start, (30, 1))
    path = np.concatenate([stands, drive(start, [2.95, 3.6], [2.95, 5.4], [4.5, 5.4])]) + room * TWIN
    clean, states, off = scene.clean(path), [], []
    for k, pose in enumerate(path):
        posterior = made.update(scene.observe(clean[k], k / RATE))
        states.append(posterior.state)
        off.append(float(np.hypot(*(posterior.pose - pose)[:2])))
        if k in {0, 29}:
            assert posterior.state == "ambiguous"
            first, second = posterior.hypotheses
            both = sorted([first.pose, second.pose], key=lambda p: p[0])
            assert np.array(both) == pytest.approx(np.array([start, start + TWIN]), abs=0.01)
            assert first.weight < most
    assert states[-1] == "tracking"
    assert max(off[-15:]) < 0.01
    assert max(o for o, state in zip(off, states, strict=True) if state == "tracking") < 0.05


@pytest.mark.parametrize(("weight", "state"), [(0.3, "ambiguous"), (0.01, "ambiguous"), (1e-4, "tracking")])
def test_improbable_room(weight, state):
    """The robot is not lost if nothing but another room keeps the belief from being tracked."""
    made, scene = begun("exact", 0)
    made.update(scene.observe(scene.clean(np.array([[2.0, 2.2, 0.0]]))[0], 0.0))
    made.hypotheses = [
        replace(hypothesis, weight=share)
        for hypothesis, share in zip(made.hypotheses, (1 - weight, weight), strict=True)
    ]
    assert made._state() == state
    made._unknown_place.weight = 0.5
    assert (made._state() == "ambiguous") == (weight > 0.1)
