"""The estimators that are compared."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import shapely

from common.errors import UserError
from common.geometry.world import load_world
from lab.accuracy.scenes import Scene
from services.estimator.factory import Choice, Factory, Geometry, prepare
from services.estimator.paper.perception import Descent
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.settings import Settings as ParticleSettings
from services.estimator.shared.interface import Estimator

STEPS = "10 steps a scan"  # of the paper's estimator as the service has it: its robot does not stand between two
NAMES = (
    "paper", f"paper, {STEPS}", "precise", "particle-filter", "particle-filter, heading known",
    "amcl-defaults", "precise, odometry", "particle-filter, odometry", "amcl-defaults, odometry",
)  # fmt: skip
# One gradient step a scan, as the paper's algorithm 1. The step size lies where `presage experiment alpha` is flat.
PAPER = Descent(iterations=1)


@dataclass(frozen=True)
class Field:
    """Where they meet: a world, a number of beams, the one heading the paper's decoder knows."""

    world: str = "corridor"
    beams: int = 622

    def scene(self, *seed: int) -> Scene:
        """With the shipped scanner; its noise and places are drawn from these seeds."""
        return Scene.of(load_world(self.world), self.beams, seed)

    def front(self) -> float:
        """M, the least y of any object of the world: below it lies the corridor's free middle. None: infinity."""
        objects = [obstacle.shape() for obstacle in load_world(self.world).obstacles]
        return float(shapely.bounds(objects)[:, 1].min()) if objects else np.inf

    @property
    def heading(self) -> float:
        """Rad."""
        return float(load_world(self.world).start_pose(0.0)[2])


def descent_of(alpha: float | None, steps: int | None) -> Descent:
    """The paper's parameters; where one is None, those of `PAPER`."""
    return Descent(alpha=PAPER.alpha if alpha is None else alpha, iterations=steps or PAPER.iterations)


def chosen(names: str) -> tuple[str, ...]:
    """From a comma-separated text; "particle-filter odometry" may stand for "particle-filter, odometry"."""
    by_name = {name.replace(",", ""): name for name in NAMES}
    asked = [" ".join(part.split()) for part in names.split(",")]
    if unknown := [name for name in asked if name not in by_name]:
        raise UserError(f"no estimator {unknown[0]!r}: choose from {', '.join(by_name)}")
    return tuple(by_name[name] for name in asked)


def knows_heading(name: str) -> bool:
    """Whether this one is given the robot's heading."""
    return name.startswith("paper") or name.endswith("heading known")


def uses_odometry(name: str) -> bool:
    """Whether this one is told of motion."""
    return name.endswith("odometry")


def enter(name: str, field: Field, scene: Scene, seed: int, descent: Descent = PAPER) -> Estimator:
    """A new estimator that knows nothing but the world; the paper's begins at the map's centre, as there."""
    scanner, kind = scene.scanner, name.split(",", maxsplit=1)[0]
    geometry = Geometry.of(scanner)
    if kind == "paper":
        return _factory(field.world, "paper", Descent() if name.endswith(STEPS) else descent)(geometry)
    if kind == "precise":
        return _factory(field.world, "precise", descent)(geometry)
    # The default motion model, differential, cannot follow a base that moves sideways: nobody would leave it.
    settings = ParticleSettings(robot_model_type="omni") if kind == "amcl-defaults" else ParticleSettings.tuned()
    heading = field.heading if name.endswith("heading known") else None
    return ParticleFilter(scene.world, settings, scanner.mount, seed, heading)


@functools.lru_cache(maxsize=8)
def _factory(world: str, name: str, descent: Descent) -> Factory:
    try:
        return prepare(Choice(world, name, descent=descent))  # type: ignore[arg-type]
    except UserError as error:
        raise UserError(f"{error}; or leave {name} out: --estimators names who takes part") from None
