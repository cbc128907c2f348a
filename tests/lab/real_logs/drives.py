"""An artificial drive like a real robot's: moved furniture, people, lost beams and inaccurate reference poses."""

from __future__ import annotations

import numpy as np

from common.geometry import se2
from common.geometry.world import World
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.shared.generative_models import RayCaster

WALLS = [(0, 0), (9, 0), (9, 3), (6, 3), (6, 6), (0, 6)]
CHAIRS = [{"circle": {"center": c, "radius": 0.3}} for c in ((2.2, 4.6), (7.6, 0.9))]
BEFORE = World(name="before", boundary=WALLS, obstacles=[*CHAIRS, {"box": {"center": (4.2, 1.2), "size": (0.6, 0.4)}}])
AFTER = World(name="after", boundary=WALLS, obstacles=[*CHAIRS, {"box": {"center": (1.0, 1.0), "size": (0.6, 0.4)}}])
ANGLES = np.deg2rad(np.linspace(-90, 90, 121))
RANGE_MAX = 30.0
SIGMA, POSED = 0.01, (0.02, 0.02, 0.004)  # m of a range; m, m, rad of a reference pose
SHORT, LONG, NONE = 0.08, 0.03, 0.02  # shares of the beams


def drive(count: int, seed: int = 0, period: float = 0.25) -> ReferenceDrive:
    """A drive around the room with drifting odometry; between its halves the box is moved."""
    rng = np.random.default_rng(seed)
    turn = 2 * np.pi * np.arange(count) * 0.45 * period / 10.0
    true = np.stack([3.0 + 1.6 * np.cos(turn), 3.0 + 1.3 * np.sin(turn)], -1)
    ahead = np.roll(true, -1, axis=0) - true
    ahead[-1] = ahead[-2]
    poses = np.column_stack([true, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))])
    half = count // 2
    ranges = np.concatenate(
        [
            RayCaster(world).expect(part, ANGLES).ranges
            for world, part in ((BEFORE, poses[:half]), (AFTER, poses[half:]))
        ]
    )
    seen = disturbed(ranges + SIGMA * rng.standard_normal(ranges.shape), rng)
    steps = se2.between(poses[:-1], poses[1:]) + rng.standard_normal((count - 1, 3)) * [0.004, 0.004, 0.004]
    odom = np.zeros((count, 3))
    for k, step in enumerate(steps, 1):
        odom[k] = se2.compose(odom[k - 1], step)
    reference = poses + rng.standard_normal(poses.shape) * POSED
    reference[:, 2] = se2.wrap(reference[:, 2])
    return ReferenceDrive(period * np.arange(count), reference, seen, ANGLES, np.zeros(3), RANGE_MAX, odom)


def disturbed(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ranges in which some beams are shortened, some random and some without return."""
    kind = rng.choice(4, ranges.shape, p=[1 - SHORT - LONG - NONE, SHORT, LONG, NONE])
    early, anywhere = rng.uniform(0, ranges), rng.uniform(0, RANGE_MAX, ranges.shape)
    return np.select([kind == 1, kind == 2, kind == 3], [early, anywhere, np.inf], ranges)


def save(path, made: ReferenceDrive, *, reference: bool = True) -> None:
    """Saves a drive as an .npz file for `presage import` and `presage train --from`."""
    poses = {"reference": made.poses} if reference else {}
    np.savez(
        path, ranges=made.ranges, angles=made.angles, range_max=made.range_max, stamps=made.stamps, odom=made.odom,
        **poses,
    )  # fmt: skip
