"""The cases of the benchmark, and the scans of one trial."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.ray_casting import cast_rays
from common.geometry.se2 import Array
from common.geometry.world import World
from common.robot.scanner import Scanner
from lab.accuracy.scenes import TIM571, Scene
from lab.integrity import changes, maps
from lab.integrity.buildings import Building, Kind, make_building
from services.estimator.shared.interface import Observation
from services.simulator.odometry import Odometer, OdometryNoise

BEAMS = 622
KIDNAPPING_PERIOD_S = 2.0  # between two kidnappings
START_DEVIATION = np.array([0.05, 0.05, np.deg2rad(1)])  # m, m, rad, of a known start; 7 cm RMS
WRONG_MAP_SEED = 1_000_000  # added to a world's seed to get the building that the wrong map shows
MAP_SCALE = 1.01  # factor on all coordinates of case scaled-map
SLIP_SPEED, SLIP_TURN = 0.5, 0.3  # m/s and rad/s that odometry reports in addition while the wheels slip
SLIP_S, SLIP_PERIOD_S = 1.0, 10.0  # duration, and mean time between two slips


@dataclass(frozen=True)
class IntegrityCase:
    """How the real world, scanner and odometry of a trial differ from what the estimator is given."""

    name: str
    seconds: float = 60.0
    building: Kind = "office"
    map: Literal["exact", "scaled", "grid", "other"] = "exact"
    start_known: bool = True
    # Probability for each piece of furniture; for `added`, the number of new pieces per old one
    moved: float = 0.0
    added: float = 0.0
    removed: float = 0.0
    doors_closed: float = 0.0  # probability for each door
    people_per_m2: float = 0.0
    glass: float = 0.0  # probability for each inner wall, and each 2 m of the outer walls, of no return
    black: float = 0.0  # the same for each piece of furniture
    kidnapping: changes.Kidnapping | None = None
    odometry: float | None = None  # its noise, relative to the simulator's; None for no odometry
    slip: bool = False
    sigma: float = 1.0  # the scanner's real noise, relative to what it states
    mount_yaw_deg: float = 0.0  # of the real scanner, relative to what it states
    range_max: float = TIM571.range_max  # m
    single_scans: int = 0  # number of scans instead of a drive, each from an unknown pose

    @property
    def map_is_correct(self) -> bool:
        """Whether the map shows the walls and furniture as they are."""
        changed = self.moved or self.added or self.removed or self.doors_closed or self.people_per_m2
        return self.map in ("exact", "grid") and not changed


CASES = {
    case.name: case
    for case in (
        IntegrityCase("unchanged"),
        IntegrityCase("moved-25", 120, moved=0.25),
        IntegrityCase("moved-50", 120, moved=0.5),
        IntegrityCase("moved-100", 120, moved=1.0),
        IntegrityCase("added", added=0.4),
        IntegrityCase("removed", removed=0.5),
        IntegrityCase("doors-closed", doors_closed=0.5),
        IntegrityCase("crowd", people_per_m2=0.08),
        IntegrityCase("kidnapped-anywhere", kidnapping="anywhere"),
        IntegrityCase("kidnapped-similar", kidnapping="similar"),
        IntegrityCase("kidnapped-nearby", kidnapping="nearby"),
        IntegrityCase("symmetric-rooms", building="symmetric", start_known=False),
        IntegrityCase("long-corridor", building="corridor", range_max=8.0),
        IntegrityCase("glass", glass=0.4),
        IntegrityCase("black", black=0.4),
        IntegrityCase("rotated-scanner", mount_yaw_deg=2.0),
        IntegrityCase("sigma-half", sigma=0.5),
        IntegrityCase("sigma-double", sigma=2.0),
        IntegrityCase("odometry", odometry=1.0),
        IntegrityCase("odometry-too-good", odometry=2.0),
        IntegrityCase("odometry-too-bad", odometry=0.5),
        IntegrityCase("slip", odometry=1.0, slip=True),
        IntegrityCase("scaled-map", map="scaled"),
        IntegrityCase("noisy-map", map="grid"),
        IntegrityCase("wrong-map", map="other", start_known=False),
        IntegrityCase("single-scan-moved-50", moved=0.5, single_scans=100, start_known=False),
        IntegrityCase("unknown-start", start_known=False),
    )
}


@dataclass(frozen=True)
class IntegrityTrial:
    """The scans of one trial, with what the estimator is given and what is true."""

    map_world: World
    scanner: Scanner  # as stated to the estimator
    observations: list[Observation]
    truths: Array  # (N, 3) base_link in map; NaN where the robot is not in the map
    start: tuple[Array, Array] | None  # pose (3,) and covariance (3, 3); None if unknown
    map_is_correct: bool
    kidnappings: npt.NDArray[np.int_]  # (K,) indices of the first scans at another place
    separate: bool  # every scan is a trial of its own, from an unknown start


def make_trial(case: IntegrityCase, seed: int, seconds: float | None) -> IntegrityTrial:
    """The trial of a case in the world of a seed; with ``seconds`` None, its length is the case's own."""
    rng = np.random.default_rng([seed, zlib.crc32(case.name.encode())])
    stated = scanner_of(case)
    scanner = _real_scanner(case, stated)
    building = make_building(seed, case.building)
    changed = _changed(case, building, rng)
    world = changed.world_with(changes.closed_doors(building, case.doors_closed, rng))
    scene = Scene(world, scanner, rng)
    path, kidnappings = _path(case, scene, seconds or case.seconds)
    clean = _ranges(case, changed, scene, path)
    odometry = _odometry(case, path, scanner.rate, rng)
    observations = [
        scene.observe(ranges, k / scanner.rate, None if odometry is None else odometry[k])
        for k, ranges in enumerate(clean)
    ]
    truths = _truths_in_map(case, path)
    start = None
    if case.start_known:
        offset = START_DEVIATION * rng.standard_normal(3)
        start = truths[0] + offset, np.diag(START_DEVIATION**2)
    return IntegrityTrial(
        map_of(case, seed), stated, observations, truths, start, case.map_is_correct, kidnappings, case.single_scans > 0
    )


def scanner_of(case: IntegrityCase) -> Scanner:
    """The scanner as stated to the estimator."""
    return Scanner.model_validate({**TIM571.model_dump(), "beams": BEAMS, "range_max": case.range_max})


def map_of(case: IntegrityCase, seed: int) -> World:
    """The map that the estimator is given. Its name is unique for each seed and map."""
    if case.map == "other":
        return make_building(seed + WRONG_MAP_SEED, case.building).world
    world = make_building(seed, case.building).world
    if case.map == "scaled":
        return maps.scaled_map(world, MAP_SCALE)
    return world if case.map == "exact" else maps.noisy_grid(Scene.of(world, BEAMS, [seed, 5]))


def _real_scanner(case: IntegrityCase, stated: Scanner) -> Scanner:
    x, y, yaw = stated.mount
    mount = (x, y, yaw + float(np.deg2rad(case.mount_yaw_deg)))
    return stated.model_copy(update={"sigma": case.sigma * stated.sigma, "mount": mount})


def _changed(case: IntegrityCase, building: Building, rng: np.random.Generator) -> Building:
    """The building with the case's changes of its furniture."""
    for share, change in (
        (case.moved, changes.move_furniture),
        (case.added, changes.add_furniture),
        (case.removed, changes.remove_furniture),
    ):
        if share:
            building = change(building, share, rng)
    return building


def _path(case: IntegrityCase, scene: Scene, seconds: float) -> tuple[Array, npt.NDArray[np.int_]]:
    """True poses (N, 3), and the indices at which the robot was carried to another place."""
    if case.single_scans:
        return scene.poses(case.single_scans), np.zeros(0, int)
    if case.kidnapping is None:
        return scene.path(seconds), np.zeros(0, int)
    places = changes.KidnappingPlaces(scene, case.kidnapping)
    parts = [scene.path(KIDNAPPING_PERIOD_S)]
    for _ in range(int(seconds / KIDNAPPING_PERIOD_S) - 1):
        parts.append(scene.path(KIDNAPPING_PERIOD_S, start=places.after(parts[-1][-1])))
    return np.concatenate(parts), np.cumsum([len(part) for part in parts[:-1]])


def _ranges(case: IntegrityCase, building: Building, scene: Scene, path: Array) -> Array:
    """Noise-free ranges (N, B) m along the path, with people and surfaces without return."""
    scanner = scene.scanner
    lasers = se2.compose(path, np.array(scanner.mount))
    if case.people_per_m2:
        count = round(case.people_per_m2 * scene.world.free_area)
        people = changes.crowd(scene.world, path, scanner.rate, count, scene.rng)
        ranges = np.concatenate(
            [
                cast_rays(scene.world, laser, scanner.angles(), discs)
                for laser, discs in zip(lasers, people, strict=True)
            ]
        )
    else:
        ranges = scene.clean(path)
    silent = [
        *changes.glass(building, case.glass, scene.rng),
        *changes.black_furniture(building, case.black, scene.rng),
    ]
    if silent:
        ranges[changes.hits(silent, ranges, lasers, scanner.angles())] = np.inf
    return ranges


def _odometry(case: IntegrityCase, path: Array, rate: float, rng: np.random.Generator) -> Array | None:
    """Poses (N, 3) in odom, or None without odometry."""
    if case.odometry is None:
        return None
    usual = OdometryNoise()
    odometer = Odometer(OdometryNoise(*(value * case.odometry**2 for value in vars(usual).values())), rng)
    poses, slips_until = [odometer.pose], -np.inf
    for k in range(1, len(path)):
        after = path[k]
        if case.slip and rng.random() < 1 / (SLIP_PERIOD_S * rate):
            slips_until = k + SLIP_S * rate
        if k < slips_until:
            after = se2.compose(after, np.array([SLIP_SPEED, 0.0, SLIP_TURN]) / rate)
        odometer.move(path[k - 1], after)
        poses.append(odometer.pose)
    return np.array(poses)


def _truths_in_map(case: IntegrityCase, path: Array) -> Array:
    """The places (N, 3) in the map that correspond to the true poses; NaN in the map of another building."""
    if case.map == "other":
        return np.full_like(path, np.nan)
    return path * [MAP_SCALE, MAP_SCALE, 1.0] if case.map == "scaled" else path
