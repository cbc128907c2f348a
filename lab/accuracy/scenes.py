"""Places, paths and scans for the tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS, Scanner
from lab.accuracy.furniture import CATALOGUE, FurniturePiece
from services.estimator.shared.interface import Observation

ROBOT = Robot()
TIM571 = SCANNERS["tim571"]
GLASS_SHARE = 0.25  # of unknown furniture
MAX_SPEED, MAX_TURN_RATE = 1.0, 1.0  # m/s, rad/s, on the paths


@dataclass
class Scene:
    """A world, a scanner and a random generator; scans are exact rays in the world plus noise."""

    world: World
    scanner: Scanner
    rng: np.random.Generator

    @classmethod
    def of(cls, world: World, beams: int | None, seed: int | Sequence[int], scanner: Scanner = TIM571) -> Scene:
        """A scene with ``beams`` beams of the scanner, or the scanner's own number if None."""
        return cls(world, scanner.with_beams(beams), np.random.default_rng(seed))

    def poses(self, count: int) -> Array:
        """Random poses (count, 3): uniform over places where the robot fits, with uniform headings."""
        return self.world.sample_poses(count, self.rng, ROBOT.radius)

    def clean(self, poses: Array) -> Array:
        """Noise-free ranges (N, B), m, at base_link poses (N, 3)."""
        lasers = se2.compose(poses, np.array(self.scanner.mount))
        return np.asarray(self.world.ray_distances(lasers, self.scanner.angles()))

    def observe(
        self, clean: Array, stamp: float, odom: Array | None = None, time_increment: float = 0.0
    ) -> Observation:
        """Observation of noise-free ranges (B,) with fresh noise added."""
        scanner = self.scanner
        return Observation(
            scanner.limit(scanner.add_noise(clean, self.rng)),
            scanner.angles(),
            scanner.range_max,
            stamp,
            odom,
            time_increment=time_increment,
        )

    def blocked(self, clean: Array, share: float) -> Array:
        """Ranges (B,) with unknown obstacles, such as people, in at least ``share`` of the beams.

        Each obstacle limits a random sector to a distance between 0.3 and 4 m.
        """
        ranges, hidden = clean.copy(), np.zeros(len(clean), bool)
        while hidden.mean() < share:
            middle, half = self.rng.integers(len(clean)), self.rng.integers(5, 31) * len(clean) // 622
            sector = slice(max(0, middle - half), middle + half + 1)
            distance = self.rng.uniform(0.3, 4.0)
            hidden[sector] |= ranges[sector] > distance
            ranges[sector] = np.minimum(ranges[sector], distance)
            if (ranges < 0.31).all():
                break
        return np.asarray(ranges)

    def furnished(self, pose: Array, share: float) -> Array:
        """Ranges (B,) at ``pose`` (3,) with unknown furniture in at least ``share`` of the beams.

        The pieces are those of generated buildings, such as cupboards, tables and chairs; a quarter of them are of
        glass, from which no beam returns.
        """
        clean = self.clean(pose[None])[0]
        laser = se2.compose(pose, np.array(self.scanner.mount))
        nearest, silent = clean.copy(), np.zeros(len(clean), bool)
        while ((nearest < clean) | silent).mean() < share:
            shape, small, large, _ = CATALOGUE[self.rng.integers(len(CATALOGUE))]
            width, depth = self.rng.uniform(small, large)
            piece = FurniturePiece(shape, (width, width if shape == "disc" else depth))
            away = self.rng.uniform(ROBOT.radius + np.hypot(*piece.size) / 2, 4.0)
            bearing, yaw = self.rng.uniform(-np.pi, np.pi, 2)
            piece = piece.at(np.array([*(pose[:2] + away * np.array([np.cos(bearing), np.sin(bearing)])), yaw]))
            alone = self.world.with_obstacles(list(piece.obstacles))
            seen = alone.ray_distances(laser[None], self.scanner.angles())[0]
            hidden = seen < nearest
            nearest[hidden], silent[hidden] = seen[hidden], self.rng.random() < GLASS_SHARE
        return np.where(silent, np.inf, nearest)

    def path(self, seconds: float, start: Array | None = None, *, at_full_speed: bool = False) -> Array:
        """Poses (N, 3), one per scan, of a drive between random places along free straight lines.

        The drive begins at rest at ``start`` (3,), or at a random pose. Speeds are up to `MAX_SPEED` and
        `MAX_TURN_RATE`, or just these ``at_full_speed``, and accelerations are within the robot's limits.
        """
        dt = 1 / self.scanner.rate
        room = shapely.buffer(self.world.free_space, -ROBOT.radius)
        shapely.prepare(room)
        pose, velocity, turn = self.poses(1)[0] if start is None else start, np.zeros(2), 0.0
        target, wanted_speed, wanted_turn = pose[:2], 0.0, 0.0
        poses = [pose]
        while len(poses) < seconds * self.scanner.rate:
            if np.hypot(*(target - pose[:2])) < 0.1 or self.rng.random() < 0.005:
                target = self._random_visible_place(room, pose[:2])
                wanted_speed = self.rng.uniform(0.2, MAX_SPEED)
                wanted_turn = self.rng.uniform(-MAX_TURN_RATE, MAX_TURN_RATE)
                if at_full_speed:
                    wanted_speed, wanted_turn = MAX_SPEED, float(np.copysign(MAX_TURN_RATE, wanted_turn))
            towards = target - pose[:2]
            distance = float(np.hypot(*towards))
            wanted = towards / max(distance, 1e-9) * min(wanted_speed, np.sqrt(2 * 0.5 * distance))
            change = wanted - velocity
            velocity = velocity + change * min(1.0, ROBOT.acceleration * dt / max(float(np.hypot(*change)), 1e-9))
            turn += float(np.clip(wanted_turn - turn, -ROBOT.turn_acceleration * dt, ROBOT.turn_acceleration * dt))
            ahead = pose[:2] + velocity * dt
            if not shapely.covers(room, shapely.Point(ahead)):  # braked too late; stop as at a wall
                ahead, velocity, target = pose[:2], np.zeros(2), pose[:2]
            pose = np.array([*ahead, float(se2.wrap(pose[2] + turn * dt))])
            poses.append(pose)
        return np.array(poses)

    def _random_visible_place(self, room: shapely.Geometry, place: Array) -> Array:
        for candidate in self.world.sample_free(200, self.rng, ROBOT.radius):
            if shapely.covers(room, shapely.LineString(np.array([place, candidate]))):
                return np.asarray(candidate)
        return place


TWIN_OFFSET = 6.1  # m along x from one room to the identical one
TWINS = World(
    name="twins",
    boundary=[(0, 0), (12, 0), (12, 6), (0, 6)],
    obstacles=[
        # Two identical rooms, each with a door to a common corridor; an object at one end of the corridor breaks the
        # symmetry.
        {"polygon": [(5.9, 0), (6.1, 0), (6.1, 4), (5.9, 4)]},
        {"polygon": [(0, 4), (2.4, 4), (2.4, 4.15), (0, 4.15)]},
        {"polygon": [(3.5, 4), (8.5, 4), (8.5, 4.15), (3.5, 4.15)]},
        {"polygon": [(9.6, 4), (12, 4), (12, 4.15), (9.6, 4.15)]},
        {"box": {"center": (1.0, 1.2), "size": (0.6, 0.9), "yaw_deg": 20}},
        {"box": {"center": (7.1, 1.2), "size": (0.6, 0.9), "yaw_deg": 20}},
        {"circle": {"center": (4.4, 2.6), "radius": 0.3}},
        {"circle": {"center": (10.5, 2.6), "radius": 0.3}},
        {"box": {"center": (0.4, 5.6), "size": (0.6, 0.5)}},
    ],
)


def twin_path(scene: Scene) -> tuple[Array, int]:
    """A path (N, 3) from inside one of the rooms into the corridor.

    Also returns the number of scans at its start that would be identical in the other room.
    """
    while True:
        pose = np.array([*scene.rng.uniform([0.6, 0.4], [5.4, 2.2]), scene.rng.uniform(-np.pi, np.pi)])
        if not scene.world.has_room(pose, ROBOT.radius) or not _has_free_line_to_door(scene, pose):
            continue
        if alike(scene, pose[None])[0]:
            break
    side = float(scene.rng.integers(2)) * TWIN_OFFSET
    corners = np.array([pose[:2], [2.95, 3.4], [2.95, 5.0], [4.5, 5.0]])
    legs = [np.linspace(a, b, max(2, int(np.hypot(*(b - a)) * 30))) for a, b in pairwise(corners)]
    places = np.concatenate([np.tile(pose[:2], (5, 1)), *legs])
    poses = np.column_stack([places, np.full(len(places), pose[2])])
    same = alike(scene, poses)
    poses[:, 0] += side
    return poses, int(np.argmin(same)) if not same.all() else len(same)


def twin_of(poses: Array) -> Array:
    """Poses (..., 3) at the same place and heading in the other room."""
    offset = np.where(poses[..., :1] < TWIN_OFFSET, TWIN_OFFSET, -TWIN_OFFSET)
    return np.asarray(poses + offset * np.array([1.0, 0.0, 0.0]))


def alike(scene: Scene, poses: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Whether the noise-free scans at ``poses`` (N, 3) are identical to those at their twins; (N,)."""
    return np.asarray(np.abs(scene.clean(poses) - scene.clean(twin_of(poses))).max(axis=1) < 1e-6)


def _has_free_line_to_door(scene: Scene, pose: Array) -> bool:
    line = shapely.LineString(np.array([pose[:2], [2.95, 3.4]]))
    return bool(shapely.covers(shapely.buffer(scene.world.free_space, -ROBOT.radius), line))
