"""One estimator over one half of a drive."""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import load_world
from lab.accuracy.compared_estimators import ScanMatchedOdometry
from lab.statistics import squared_mahalanobis
from presage.learning.train_drive import drive_of, split
from presage.logs.log import Reading
from presage.logs.scan_files import read_scans
from services.estimator.factory import EstimatorFactory, EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.sensor import Sensor
from services.estimator.particle_filter.settings import ParticleFilterSettings
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.shared.interface import Observation, PoseEstimator

MAX_SEARCH_SCANS = 40  # after an unknown start or a kidnapping
SCANS_BEFORE_KIDNAPPING = 10  # from a given pose on
START_COVARIANCE = np.diag([0.01, 0.01, 0.0025])  # m², m², rad²; of the given start pose
# AMCL's default motion model is differential and cannot follow every base, so its omnidirectional model is used.
AMCL_SETTINGS = ParticleFilterSettings(robot_model_type="omni")
ODOMETRY, LASER, GLOBAL, KIDNAPPED = "odometry", "laser", "global", "kidnapped"  # LASER: without odometry
SCAN_MATCHING_FILTER = "particle-filter-scan-matching"
FILTERS = ("particle-filter", SCAN_MATCHING_FILTER)  # those that are tuned
ESTIMATORS = ("precise", "precise-exact", *FILTERS, "amcl-defaults")


@dataclass(frozen=True)
class StretchJob:
    """One estimator on one stretch of a drive; all values are plain, so that jobs can be compared and pickled."""

    log: str
    map: str
    mount: tuple[float, float, float] | None  # pose of the laser in base_link; None for the log's own
    estimator: str  # one of `ESTIMATORS`
    task: str  # ODOMETRY, LASER, GLOBAL or KIDNAPPED
    first: int  # index of the first scan
    count: int = 0  # number of scans; GLOBAL: 0 for `MAX_SEARCH_SCANS`; not used by KIDNAPPED
    to: int = 0  # task kidnapped: index of the scan to which the robot is moved
    model: str = ""  # weights file of estimator precise
    particles: tuple[tuple[str, float], ...] = ()  # settings of a tuned particle filter, by name
    seed: int = 1  # of the particle filter
    exchanged: bool = False  # whether the second half of the drive is the training half

    @property
    def drive(self) -> ReferenceDrive:
        """The whole drive, with the training half first."""
        return drive_at(self.log, self.mount, exchanged=self.exchanged)

    @property
    def learned(self) -> int:
        """Number of scans in the training half of `drive`, which is also the index of the first scan after it."""
        return training_scans(self.log, self.mount, exchanged=self.exchanged)


@functools.lru_cache(maxsize=2)
def drive_at(log: str, mount: tuple[float, float, float] | None, *, exchanged: bool) -> ReferenceDrive:
    """The scans of a log that have reference poses; cached per process. ``exchanged`` puts the second half first."""
    if exchanged:
        return exchange_halves(drive_at(log, mount, exchanged=False))
    path = Path(log)
    return drive_of(read_scans(path, reading=Reading(mount=None if mount is None else np.array(mount))), path)


def training_scans(log: str, mount: tuple[float, float, float] | None, *, exchanged: bool) -> int:
    """Number of scans in the half with which `drive_at` begins."""
    first, second = split(drive_at(log, mount, exchanged=False))
    return len((second if exchanged else first).ranges)


def exchange_halves(drive: ReferenceDrive) -> ReferenceDrive:
    """The drive with its halves exchanged; the first half follows the second after a usual scan interval."""
    early, late = split(drive)
    offset = late.stamps[-1] + float(np.median(np.diff(drive.stamps))) - early.stamps[0]
    exchanged = drive.part(np.roll(np.arange(len(drive.ranges)), -len(early.ranges)))
    return replace(exchanged, stamps=np.concatenate([late.stamps, early.stamps + offset]))


def trial(job: StretchJob) -> dict[str, Any]:
    """Runs the job's estimator over its stretch. Returns errors, states and times of every scan."""
    drive, estimator = job.drive, create_estimator(job)
    if job.task != GLOBAL:
        estimator.restart(drive.poses[job.first], START_COVARIANCE)
    if job.task in (ODOMETRY, LASER):
        indices = np.arange(job.first, job.first + job.count)
    elif job.task == GLOBAL:
        indices = np.arange(job.first, min(job.first + (job.count or MAX_SEARCH_SCANS), len(drive.ranges)))
    else:
        after = np.arange(job.to, min(job.to + MAX_SEARCH_SCANS, len(drive.ranges)))
        indices = np.concatenate([np.arange(job.first, job.first + SCANS_BEFORE_KIDNAPPING), after])
    clock = drive.stamps[indices]
    odom = None if drive.odom is None or job.task == LASER else drive.odom[indices]
    if job.task == KIDNAPPED:  # the stamps have no gap at the kidnapping
        clock[SCANS_BEFORE_KIDNAPPING:] += (
            drive.stamps[job.first + SCANS_BEFORE_KIDNAPPING] - clock[SCANS_BEFORE_KIDNAPPING]
        )
        odom = None if odom is None else hide_kidnapping(odom, SCANS_BEFORE_KIDNAPPING)
    rows: dict[str, list[Any]] = {name: [] for name in ("stamp_s", "error_m", "yaw_error_rad", "state", "nees", "ms")}
    for i, k in enumerate(indices):
        stamp, odom_pose = float(clock[i]), se2.known_pose(odom, i)
        observation = Observation(drive.ranges[k], drive.angles, drive.range_max, stamp, odom_pose)
        began = time.process_time()
        posterior = estimator.update(observation)
        rows["ms"].append(round((time.process_time() - began) * 1e3, 2))
        error = se2.difference(posterior.pose, drive.poses[k])
        rows["stamp_s"].append(round(stamp, 4))
        rows["error_m"].append(round(float(np.hypot(error[0], error[1])), 5))
        rows["yaw_error_rad"].append(round(abs(float(error[2])), 5))
        rows["state"].append(posterior.state)
        covariance = posterior.covariance
        rows["nees"].append(None if covariance is None else round(squared_mahalanobis(error, covariance), 3))
    return {"estimator": job.estimator, "task": job.task, "first": job.first, "to": job.to, **rows}


def hide_kidnapping(odom: Array, first_after: int) -> Array:
    """Odometry (N, 3) without the motion just before scan ``first_after``, as if the robot had been lifted.

    Where odometry is unknown, it is NaN, and the motion over unknown scans at the lift is left out, too.
    """
    known = np.flatnonzero(np.isfinite(odom).all(axis=1))
    before, after = known[known < first_after], known[known >= first_after]
    hidden = odom.copy()
    if len(before) and len(after):
        hidden[after] = se2.compose(odom[before[-1]], se2.between(odom[after[0]], odom[after]))
    return np.asarray(hidden)


def create_estimator(job: StretchJob) -> PoseEstimator:
    """A new estimator for the job's map, without a start pose."""
    drive = job.drive
    geometry = ScannerGeometry(drive.angles, drive.mount, drive.range_max)
    if job.estimator in ("precise", "precise-exact"):
        return _precise(job.map, job.model if job.estimator == "precise" else "exact")(geometry)
    settings = AMCL_SETTINGS if job.estimator == "amcl-defaults" else particle_settings(job.particles)
    x, y, yaw = map(float, drive.mount)
    sensor = _sensor(job.map, settings)
    particle_filter = ParticleFilter(load_world(job.map), settings, (x, y, yaw), job.seed, sensor=sensor)
    return ScanMatchedOdometry(particle_filter, geometry) if job.estimator == SCAN_MATCHING_FILTER else particle_filter


def particle_settings(changed: tuple[tuple[str, float], ...]) -> ParticleFilterSettings:
    """Settings of the particle filter: the tuned set, or AMCL's if "amcl_defaults" is 1, with the given changes."""
    types = {"max_beams": int, "keep_initial_pose": bool}
    values = {name: types[name](value) if name in types else value for name, value in changed}
    base = AMCL_SETTINGS if values.pop("amcl_defaults", 0.0) else ParticleFilterSettings.tuned()
    return replace(base, **values)  # type: ignore[arg-type]


@functools.lru_cache(maxsize=2)
def _precise(world: str, model: str) -> EstimatorFactory:
    return prepare_factory(EstimatorOptions(world, "precise", model))


@functools.lru_cache(maxsize=4)
def _sensor(world: str, settings: ParticleFilterSettings) -> Sensor:
    return Sensor(load_world(world), settings)
