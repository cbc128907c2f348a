"""What a former model knows, and what a drive contradicts."""

from __future__ import annotations

import numpy as np

from common.geometry.world import World
from services.estimator.precise.learning.drive_learning import remove_contradicted
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.generative_models import RayCaster

ROOMS = {"boundary": [(0, 0), (8, 0), (8, 4), (0, 4)]}
WALL = {"polygon": [(4, 0), (4.1, 0), (4.1, 3), (4, 3)]}  # between two rooms, with a door
BEFORE = World(name="before", obstacles=[WALL, {"box": {"center": (2, 1), "size": (0.6, 0.6)}}], **ROOMS)
AFTER = World(name="after", obstacles=[WALL, {"box": {"center": (1, 2.5), "size": (0.6, 0.6)}}], **ROOMS)
ANGLES = np.linspace(-np.pi, np.pi, 360, endpoint=False)


def scans(world, low, high, count, noise=0.0):
    rng = np.random.default_rng(0)
    places = rng.uniform(low, high, (20 * count, 2))
    places = places[(BEFORE.clearance(places) > 0.2) & (AFTER.clearance(places) > 0.2)][:count]
    poses = np.column_stack([places, np.zeros(count)])
    ranges = RayCaster(world).expect(poses, ANGLES).ranges
    return poses, ranges + noise * rng.standard_normal(ranges.shape)


def test_replay_of_what_is_not_contradicted():
    poses, ranges = scans(BEFORE, (0.3, 0.3), (7.7, 3.7), 150)
    replayed = Beams.of(poses, np.zeros(3), ANGLES, ranges)
    now = Beams.of(poses, np.zeros(3), ANGLES, RayCaster(AFTER).expect(poses, ANGLES).ranges)
    # The drive stays in the west room.
    driven, seen = scans(AFTER, (0.3, 0.3), (3.7, 3.7), 60, 0.02)
    measured = Beams.of(driven, np.zeros(3), ANGLES, seen)
    kept = remove_contradicted(measured, replayed, 0.05)
    is_kept = np.isin(replayed.directions + 10 * replayed.starts[:, 0], kept.directions + 10 * kept.starts[:, 0])
    west = replayed.starts[:, 0] < 3.8
    gone = now.ranges > replayed.ranges + 0.2
    blocked = now.ranges < replayed.ranges - 0.2
    assert is_kept[~west & ~gone & ~blocked].mean() > 0.99
    assert is_kept[west & ~gone & ~blocked].mean() > 0.95
    assert is_kept[west & blocked].mean() < 0.1
    assert is_kept[gone].mean() < 0.1


def test_nothing_is_replayed_through_a_new_surface():
    """Seen from the west only, a new cupboard also stops beams from behind and from inside it."""
    ranges = RayCaster(BEFORE)
    poses = np.array([[1.3, 3.2, 0.0], [1.6, 3.4, 0.0], [0.95, 2.5, 0.0]])
    replayed = Beams.of(poses, np.zeros(3), ANGLES, ranges.expect(poses, ANGLES).ranges)
    driven, seen = scans(AFTER, (0.2, 1.5), (0.6, 3.7), 60, 0.02)
    kept = remove_contradicted(Beams.of(driven, np.zeros(3), ANGLES, seen), replayed, 0.05)
    x, y = kept.starts.T
    # Where they cross the cupboard's western side
    forward = (0.7 - x) / kept.unit()[:, 0]
    at = y + forward * kept.unit()[:, 1]
    crossing = (forward > 0.05) & (forward < kept.ranges - 0.15) & (np.abs(at - 2.5) < 0.25)
    assert crossing.mean() < 0.002
