"""The estimators that are compared."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import shapely

from common.errors import UserError
from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from services.estimator.factory import EstimatorFactory, EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.paper.perception import Descent
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.settings import ParticleFilterSettings
from services.estimator.shared.interface import PoseEstimator

TEN_STEPS = "10 steps a scan"  # variant of the paper's estimator with the service's defaults, for a moving robot
NAMES = (
    "paper",
    f"paper, {TEN_STEPS}",
    "precise",
    "particle-filter",
    "particle-filter, heading known",
    "amcl-defaults",
    "precise, odometry",
    "particle-filter, odometry",
    "amcl-defaults, odometry",
)
# One gradient step per scan, as in the paper's algorithm 1. The default step size lies where the results of
# `presage experiment alpha` hardly depend on it.
PAPER_DESCENT = Descent(iterations=1)


@dataclass(frozen=True)
class ExperimentWorld:
    """World and number of beams of an experiment. All estimators run in the same one."""

    world: str = "corridor"
    beams: int = 622

    def scene(self, *seed: int) -> Scene:
        """A scene with the default scanner; the seeds determine its noise and places."""
        return Scene.of(load_world(self.world), self.beams, seed)

    def front(self) -> float:
        """Smallest y of any obstacle in m; the corridor is free below it. Infinity if there is no obstacle."""
        objects = [obstacle.shape() for obstacle in load_world(self.world).obstacles]
        return float(shapely.bounds(objects)[:, 1].min()) if objects else np.inf

    @property
    def heading(self) -> float:
        """Heading of the robot in rad; the paper's decoder is trained for this heading only."""
        return float(load_world(self.world).start_pose(0.0)[2])


def parse_estimators(names: str, known: Iterable[str] = NAMES) -> tuple[str, ...]:
    """Estimator names from a comma-separated text, with or without the comma inside a name.

    "particle-filter, odometry" and "particle-filter odometry" are one name. Raises UserError for unknown names.
    """
    by_name = {name.replace(",", ""): name for name in known}
    parts = [" ".join(part.split()) for part in names.split(",")]
    parsed: list[str] = []
    for part in parts:
        if parsed and part not in by_name and f"{parsed[-1]} {part}" in by_name:
            parsed[-1] += f" {part}"  # the second half of a name
        else:
            parsed.append(part)
    if unknown := [name for name in parsed if name not in by_name]:
        raise UserError(f"no estimator {unknown[0]!r} in the experiments: choose from {', '.join(by_name)}")
    return tuple(by_name[name] for name in parsed)


def knows_heading(name: str) -> bool:
    """Whether the estimator is given the robot's heading."""
    return name.startswith("paper") or name.endswith("heading known")


def uses_odometry(name: str) -> bool:
    """Whether the estimator uses odometry."""
    return name.endswith("odometry")


def create_estimator(
    name: str, field: ExperimentWorld, scene: Scene, seed: int, descent: Descent = PAPER_DESCENT
) -> PoseEstimator:
    """A new estimator without a start pose. The paper's starts at the map's centre, as in the paper."""
    scanner, kind = scene.scanner, name.split(",", maxsplit=1)[0]
    geometry = ScannerGeometry.of(scanner)
    if kind == "paper":
        return _factory(field.world, "paper", Descent() if name.endswith(TEN_STEPS) else descent)(geometry)
    if kind == "precise":
        return _factory(field.world, "precise", descent)(geometry)
    # AMCL's default motion model is differential and cannot follow a base that moves sideways, so any user would
    # change it.
    settings = (
        ParticleFilterSettings(robot_model_type="omni") if kind == "amcl-defaults" else ParticleFilterSettings.tuned()
    )
    heading = field.heading if name.endswith("heading known") else None
    return ParticleFilter(scene.world, settings, scanner.mount, seed, heading)


@functools.lru_cache(maxsize=8)
def _factory(world: str, name: str, descent: Descent) -> EstimatorFactory:
    try:
        return prepare_factory(EstimatorOptions(world, name, descent=descent))  # type: ignore[arg-type]
    except UserError as error:
        raise UserError(f"{error}; or leave {name} out with --estimators") from None
