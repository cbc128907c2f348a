"""Drives through the rooms of a building, and models tested with single scans: shared by several benchmarks."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import load_world
from common.robot.scanner import Scanner
from lab.accuracy.furniture import FurniturePiece
from lab.accuracy.scenes import ROBOT, Scene
from lab.accuracy.tasks import is_at
from lab.experiments.results import millimetres
from lab.integrity.buildings import Building, Room, make_building
from lab.navigation.shortest_path import ShortestPaths
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.field_learning import Recipe, learn_field
from services.estimator.precise.learning.live_learning import ModelVersion
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.interface import Observation

SPEED, TURN_RATE, PERIOD_S = 0.6, 0.5, 0.2  # m/s, rad/s and s between scans of a drive
PLANNING_MARGIN_M = 0.02  # by which the robot is taken to be smaller, because it just fits between some pieces
PLACES_PER_ROOM = 2  # to which a drive goes
PRESENT_SCANS = 2000  # from which the model of the present world is learned


def building_of(name: str) -> Building:
    """The building of `office`, or of the seed in ``name``."""
    return office_building() if name == "office" else make_building(int(name))


def office_building() -> Building:
    """The world `office` as walls, furniture that can be moved, and rooms with a door to the corridor."""
    world = load_world("office")
    furniture, walls = [], []
    for obstacle in world.obstacles:
        if obstacle.box is not None:
            (x, y), yaw = obstacle.box.center, float(np.deg2rad(obstacle.box.yaw_deg))
            furniture.append(FurniturePiece("box", obstacle.box.size, (x, y, yaw)))
        elif obstacle.circle is not None:
            size = 2 * obstacle.circle.radius
            furniture.append(FurniturePiece("disc", (size, size), (*obstacle.circle.center, 0.0)))
        else:
            walls.append(obstacle)
    rooms = (
        Room((0.0, 0.0, 0.0), 4.9, 2.95, 2.2),
        Room((4.95, 0.0, 0.0), 5.7, 2.95, 2.65),
        Room((10.65, 0.0, 0.0), 7.35, 2.95, 2.7),
        Room((7.75, 8.0, np.pi), 7.75, 3.05, 3.35),
        Room((0.0, 2.95, 0.0), 18.0, 2.0),
        Room((7.8, 5.0, 0.0), 10.2, 3.0),
    )
    return Building("office", tuple(world.boundary), tuple(walls), rooms, tuple(furniture))


def contains(room: Room, places: Array) -> npt.NDArray[np.bool_]:
    """Mask (N,) of the places (N, 2) m in map that lie in a room."""
    box = room.box(room.width / 2, room.depth / 2, (room.width, room.depth)).box
    assert box is not None  # noqa: S101 - for the type checker
    return np.asarray((np.abs(places - box.center) < np.array(box.size) / 2).all(axis=1))


def drive_through_rooms(scene: Scene, building: Building, share: float) -> Array:
    """Poses (N, 3), `PERIOD_S` apart, of a drive to some places in each room, or in a ``share`` of the rooms.

    The robot turns all the time.
    """
    paths, rng = ShortestPaths(scene.world, ROBOT.radius - PLANNING_MARGIN_M), scene.rng
    free = scene.world.sample_free(1000, rng, ROBOT.radius)
    corridors = [room for room in building.rooms if room.door is None]
    places = [next(place for place in free if any(contains(room, place[None])[0] for room in corridors))]
    legs = []
    for number in rng.permutation(len(building.rooms)):
        room = building.rooms[number]
        if room.door is not None and rng.random() > share:
            continue
        for place in free[contains(room, free)][-PLACES_PER_ROOM:]:
            leg = paths.path(places[-1], place)
            if len(leg):
                legs += [np.linspace(a, b, 2 + int(np.hypot(*(b - a)) / (SPEED * PERIOD_S))) for a, b in pairwise(leg)]
                places.append(place)
    driven = np.concatenate(legs)
    return np.column_stack([driven, se2.wrap(TURN_RATE * PERIOD_S * np.arange(len(driven)))])


def drive_for(scene: Scene, building: Building, seconds: float) -> Array:
    """Poses (N, 3), `PERIOD_S` apart, of a drive through all rooms, once or several times, until the time is up."""
    count = round(seconds / PERIOD_S)
    path = drive_through_rooms(scene, building, 1.0)
    laps = [path, path[::-1]]  # forth and back
    return np.concatenate([laps[k % 2] for k in range(1 + count // len(path))])[:count]


def write_drive_log(scene: Scene, poses: Array, log: Path) -> None:
    """Writes the noisy scans of a drive, `PERIOD_S` apart, with its true poses (N, 3) as reference."""
    np.savez(
        log,
        ranges=np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)]),
        angles=scene.scanner.angles(),
        range_max=np.array(scene.scanner.range_max),
        stamps=PERIOD_S * np.arange(len(poses)),
        reference=poses,
    )


def learn_at_true_poses(scene: Scene) -> FieldModel:
    """A field learned from scans with noise at true poses."""
    poses, mount, angles = scene.poses(PRESENT_SCANS), np.array(scene.scanner.mount), scene.scanner.angles()
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)])
    return FieldModel(learn_field(Beams.of(poses, mount, angles, ranges), Recipe(0.05)))


def make_estimator(options: EstimatorOptions, scanner: Scanner, version: ModelVersion | None) -> PreciseEstimator:
    """An estimator without a start pose, with a ``version`` of its model if given."""
    estimator = prepare_factory(options)(ScannerGeometry.of(scanner))
    assert isinstance(estimator, PreciseEstimator)  # noqa: S101 - for the type checker
    if version is not None:
        estimator.use_model(version.model, version.seeds)
    return estimator


def errors_of_single_scans(
    options: EstimatorOptions,
    scanner: Scanner,
    scans: list[Observation],
    poses: Array,
    version: ModelVersion | None = None,
) -> list[float | None]:
    """Errors in m of single scans from unknown poses, with a ``version`` of the model if given; None if not found."""
    estimator = make_estimator(options, scanner, version)
    errors: list[float | None] = []
    for scan, pose in zip(scans, poses, strict=True):
        estimator.restart()
        estimate = estimator.update(scan).pose
        errors.append(float(np.hypot(*(estimate - pose)[:2])) if is_at(estimate, pose) else None)
    return errors


def found_of(errors: list[float | None]) -> str:
    """Single scans found of all, and the median error of these in mm."""
    found = [error for error in errors if error is not None]
    return f"{len(found)}/{len(errors)}; {millimetres(float(np.median(found)) if found else None)}"
