"""The estimators that the accuracy benchmark compares: presage, particle filters at their best, a scan matcher."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy import ndimage

from common.geometry.se2 import Array
from common.geometry.world import World
from lab.accuracy.correlative import CorrelativeMatcher
from services.estimator.factory import EstimatorOptions, EstimatorPreset, ScannerGeometry, load_model, prepare_factory
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.sensor import Sensor
from services.estimator.particle_filter.settings import ParticleFilterSettings
from services.estimator.precise.field import DistanceField, FieldModel
from services.estimator.precise.motion_model import MotionNoise
from services.estimator.shared.generative_models import GenerativeModel
from services.estimator.shared.interface import Observation, PoseEstimator, Posterior, Predicted
from services.mapper.slam.drive import Laser
from services.mapper.slam.front_end import FrontEnd

NOISE_STEP_M = 0.1  # over which the noise of AMCL's motion model equals the learned one
NOISE_STEP_RAD = 0.1
NOMINAL_PERIOD_S = 1 / 15  # of scans without stamps
# Factor on the odometry noise of particle filters with all beams. Without it, so few particles explain all beams that
# errors are twice as large. Chosen with world office and seed 5001, which no evaluation uses.
NOISE_FACTOR = 16.0
ALL_BEAMS: dict[str, object] = {"max_beams": None}
NO_RECOVERY: dict[str, object] = {"recovery_alpha_slow": 0.0, "recovery_alpha_fast": 0.0}
BEAM_MODEL: dict[str, object] = {
    "laser_model_type": "beam",
    "max_beams": 180,
    "z_hit": 0.7,
    "z_short": 0.2,
    "z_max": 0.05,
    "z_rand": 0.05,
    "lambda_short": 0.5,
}


@dataclass(frozen=True)
class EstimatorSetup:
    """What an estimator is made from: a world, the scanner, a seed, and what presage has learned of the world."""

    world: World
    geometry: ScannerGeometry
    seed: int
    learned: GenerativeModel | None = None  # None for the model shipped for the world

    def options(self, estimator: EstimatorPreset, model: str = "learned") -> EstimatorOptions:
        """The options of an estimator made as by the estimator service."""
        own = self.learned if model == "learned" and estimator == "precise" else None
        return EstimatorOptions(self.world, estimator, model, seed=self.seed, generative_model=own)

    def particle_filter(self, settings: ParticleFilterSettings, sensor: Sensor | None = None) -> ParticleFilter:
        """A particle filter without a start pose."""
        x, y, yaw = map(float, self.geometry.mount)
        return ParticleFilter(self.world, settings, (x, y, yaw), self.seed, sensor=sensor)


@dataclass(frozen=True)
class ComparedEstimator:
    """An estimator that takes part in the comparison."""

    make: Callable[[EstimatorSetup], PoseEstimator]
    learns: bool = False  # whether it uses what presage has learned of the world


@dataclass(frozen=True)
class LearnedSurfaces:
    """Stands for a world in the particle filter's likelihood field, with the distances of a learned field."""

    field: DistanceField
    bounds: tuple[float, float, float, float]  # m: x and y of the lower left corner, and of the upper right one
    name: str

    def surface_distance_on_lattice(self, x: Array, y: Array, max_dist: float) -> Array:
        """Signed distances (Y, X) m at the nodes with coordinates x (X,) and y (Y,) m, at most ``max_dist``."""
        (x0, y0), step = self.field.origin, self.field.resolution
        nodes = np.meshgrid((y - y0) / step, (x - x0) / step, indexing="ij")
        found = ndimage.map_coordinates(self.field.phi, nodes, order=1, cval=max_dist)
        return np.asarray(np.clip(found, -max_dist, max_dist))


class ScanMatchedOdometry:
    """An estimator whose odometry is that of scan matching, by the front end of presage's mapper."""

    name = "scan-matched"

    def __init__(self, estimator: PoseEstimator, geometry: ScannerGeometry) -> None:
        self._estimator, self._geometry = estimator, geometry
        self.restart()

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Restarts the front end and the estimator."""
        geometry = self._geometry
        self._front_end = FrontEnd(Laser(geometry.angles, geometry.mount, geometry.range_max))
        self._stamp = 0.0
        self._estimator.restart(pose, covariance)

    def update(self, observation: Observation) -> Posterior:
        """Matches the scan, and returns the estimator's posterior with the matched pose as odometry."""
        stamp = self._stamp + NOMINAL_PERIOD_S if observation.stamp is None else observation.stamp
        self._stamp = stamp
        matched = self._front_end.add(stamp, observation.ranges, observation.odom)
        return self._estimator.update(replace(observation, odom=matched.pose))

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """Predicts scans; see PoseEstimator."""
        return self._estimator.predict(poses, angles)


def amcl_noise(motion: MotionNoise) -> dict[str, float]:
    """The parameters alpha1 to alpha5 of AMCL's omnidirectional model for learned odometry noise.

    These are variances per square metre and square radian; the learned variances grow with the path and the turn. They
    are equal over `NOISE_STEP_M` and `NOISE_STEP_RAD`.
    """
    along = motion.path_by_path / NOISE_STEP_M
    return {
        "alpha1": motion.path_by_turn,
        "alpha2": motion.turn_by_path / NOISE_STEP_M,
        "alpha3": along,
        "alpha4": motion.turn_by_turn / NOISE_STEP_RAD,
        "alpha5": along,
    }


def _best_settings(**changed: object) -> ParticleFilterSettings:
    """The tuned particle filter with all beams, and `NOISE_FACTOR` times the odometry noise that presage assumes."""
    noise = {name: NOISE_FACTOR * value for name, value in amcl_noise(MotionNoise()).items()}
    return replace(ParticleFilterSettings.tuned(), **{**ALL_BEAMS, **noise, **changed})  # type: ignore[arg-type]


def _on_learned_field(setup: EstimatorSetup) -> PoseEstimator:
    settings = _best_settings()
    model = setup.learned or load_model(setup.options("precise"), setup.world)[0]
    assert isinstance(model, FieldModel)  # noqa: S101 - for the type checker
    surfaces = LearnedSurfaces(model.field, setup.world.bounds, setup.world.name)
    sensor = Sensor(cast("World", surfaces), settings)
    return setup.particle_filter(settings, sensor)


def _by_service(estimator: EstimatorPreset, model: str = "learned") -> Callable[[EstimatorSetup], PoseEstimator]:
    return lambda setup: prepare_factory(setup.options(estimator, model))(setup.geometry)


def _with_particles(**changed: object) -> Callable[[EstimatorSetup], PoseEstimator]:
    return lambda setup: setup.particle_filter(_best_settings(**changed))


def _scan_matched(setup: EstimatorSetup) -> PoseEstimator:
    return ScanMatchedOdometry(setup.particle_filter(_best_settings()), setup.geometry)


def _correlative(setup: EstimatorSetup) -> PoseEstimator:
    x, y, yaw = map(float, setup.geometry.mount)
    return CorrelativeMatcher(setup.world, (x, y, yaw))


COMPARED_ESTIMATORS = {
    "precise": ComparedEstimator(_by_service("precise"), learns=True),
    "precise-exact": ComparedEstimator(_by_service("precise", "exact")),
    "particle-filter": ComparedEstimator(_by_service("particle-filter")),
    "amcl-defaults": ComparedEstimator(_by_service("amcl-defaults")),
    "particle-filter-all-beams": ComparedEstimator(_with_particles()),
    "particle-filter-no-recovery": ComparedEstimator(_with_particles(**NO_RECOVERY)),
    "particle-filter-learned-field": ComparedEstimator(_on_learned_field, learns=True),
    "particle-filter-beam-model": ComparedEstimator(_with_particles(**BEAM_MODEL)),
    "particle-filter-scan-matching": ComparedEstimator(_scan_matched),
    "correlative": ComparedEstimator(_correlative),
}
