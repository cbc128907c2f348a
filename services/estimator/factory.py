"""Builds an estimator and its model from their names; opens the files."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World, known_worlds, load_world
from common.messages.definitions import Scan
from common.robot.scanner import SCANNERS, Scanner
from services.estimator.paper.perception import Descent
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.sensor import Sensor
from services.estimator.particle_filter.settings import Settings as ParticleSettings
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.gauss_newton import View, polish
from services.estimator.precise.global_seeds import SEED_SPACING_M, Seeds, thin_places
from services.estimator.precise.learning import weights
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.settings import Settings
from services.estimator.shared.generative_models import GenerativeModel, RayCaster, map_error
from services.estimator.shared.interface import Estimator

SIGMA = 0.02  # m, the noise of a scanner that states none
SAME_MOUNT = 1e-3  # m and rad
LEAST_SIGMA = 1e-3  # m, of one that states less: no surface is known better
MAP_LEVER = 5.0  # m, typical distance of walls: an error of the map there turns the pose by error / distance
Name = Literal["precise", "paper", "particle-filter", "amcl-defaults"]


@dataclass(frozen=True)
class Choice:
    """What a user chooses."""

    world: str | World = "corridor"  # a shipped one, a file, or the world itself
    estimator: Name = "precise"
    model: str = "learned"  # of precise: learned, exact, or a file of weights
    models: Path | None = None  # folder of weights; none: the shipped ones
    sigma: float | None = None  # m, the scanner's noise; None: as the scan states it, or SIGMA
    seed: int = 0
    initial_pose: Array | None = None  # (3,); none: nothing is known (paper: the map's centre)
    descent: Descent = Descent()  # noqa: RUF009 - frozen; of paper

    @property
    def asked(self) -> str:
        """The world as the user names it."""
        if isinstance(self.world, str):
            return self.world
        return self.world.name if self.world.name in known_worlds() else f"{self.world.name}.yaml"  # it was recorded


@dataclass(frozen=True)
class Geometry:
    """Of the scans to come."""

    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    sigma: float = 0.0  # m, the scanner's noise, and
    sigma_relative: float = 0.0  # its part that grows with the range; both 0: not stated
    mount_assumed: bool = False  # neither the file nor the user states the mount

    @classmethod
    def of(cls, scanner: Scanner) -> Geometry:
        """Of the scans of a scanner."""
        return cls(
            scanner.angles(), np.array(scanner.mount), scanner.range_max, scanner.sigma, scanner.sigma_relative
        )  # fmt: skip

    @classmethod
    def of_scan(cls, scan: Scan) -> Geometry:
        """Of scans like this one."""
        return cls(scan.angles(), scan.mount.array(), scan.range_max, scan.sigma, scan.sigma_relative)

    def same(self, other: Geometry, *, bound_to_beams: bool) -> bool:
        """Whether an estimator made for one takes the other; one that is ``bound_to_beams`` only with the same angles.

        Scanners whose motor sets the pace give a few beams more or less each time round.
        """
        noise = (self.sigma, self.sigma_relative) == (other.sigma, other.sigma_relative)
        if not noise or not np.allclose(self.mount, other.mount, atol=1e-4):
            return False
        if not bound_to_beams:
            return True
        return len(self.angles) == len(other.angles) and np.allclose(self.angles, other.angles, atol=1e-4)

    def upside_down(self) -> Geometry:
        """With a roll of 180 deg: seen from above the beams run the other way round."""
        return replace(self, angles=-self.angles)

    def likelihood(self, sigma: float | None = None) -> Likelihood:
        """With the noise ``sigma`` m asked for, or what the scans state, or `SIGMA`."""
        if sigma is not None:
            return Likelihood(sigma)
        if not self.sigma and not self.sigma_relative:
            return Likelihood(SIGMA)
        return Likelihood(max(self.sigma, LEAST_SIGMA), relative=self.sigma_relative)


Factory = Callable[[Geometry], Estimator]


def prepare(choice: Choice) -> Factory:
    """Load what is needed, so that errors come now; the factory makes the estimator for the first scan's geometry."""
    if choice.estimator not in get_args(Name):
        raise UserError(f"no estimator {choice.estimator!r}: choose one of {', '.join(get_args(Name))}")
    world = choice.world if isinstance(choice.world, World) else load_world(choice.world)
    check_start(choice, world)
    if choice.estimator == "paper":
        return _paper(choice, world)
    if choice.estimator == "precise":
        return _precise(choice, world)
    tuned = choice.estimator == "particle-filter"
    RayCaster(world).expect(np.zeros((1, 3)), np.zeros(1))  # compiled now, no request waits for it
    sensor = functools.cache(functools.partial(Sensor, world))  # one field, however many filters are made

    def make(geometry: Geometry) -> Estimator:
        settings = ParticleSettings.tuned() if tuned else ParticleSettings()
        if tuned:
            settings = replace(settings, robot_model_type="omni")  # covers a differential base as well
        made = ParticleFilter(world, settings, (*map(float, geometry.mount),), choice.seed, sensor=sensor(settings))  # type: ignore[arg-type]
        made.name = choice.estimator
        if choice.initial_pose is not None:
            made.restart(choice.initial_pose)
        return made

    return make


def _precise(choice: Choice, world: World) -> Factory:
    model, places, card = generative_model(choice, world)
    calibration = card.calibration if card else None
    settings = calibration.settings() if calibration else Settings(inflation=card.inflation if card else 1.0)
    if not calibration and (error := map_error(world)):
        # Neighbouring cells err alike: their error averages out neither over beams nor over scans.
        settings = replace(settings, floor_position=error, floor_heading=error / MAP_LEVER)
    seeds, bounds = Seeds.at(model, places), (card.world if card else world).bounds
    _compile(model, seeds, Likelihood())

    def make(geometry: Geometry) -> Estimator:
        if card:
            check_mount(geometry, card.scanner)
        likelihood = geometry.likelihood(choice.sigma)
        if calibration and choice.sigma is None:
            likelihood = calibration.likelihood
        rng = np.random.default_rng(choice.seed)
        made = PreciseEstimator(model, seeds, geometry.mount, likelihood, settings, rng, bounds)
        if choice.initial_pose is not None:
            made.restart(choice.initial_pose)
        return made

    return make


def generative_model(choice: Choice, world: World) -> tuple[GenerativeModel, Array, weights.FieldCard | None]:
    """The model of that name, places (S, 2) m a laser may be at, and the card of what was learned."""
    if choice.model == "exact":
        places = world.sample_free(max(4000, int(60 * world.free_area)), np.random.default_rng(0), 0.05)
        return RayCaster(world), thin_places(places, SEED_SPACING_M), None
    return weights.load(field_path(choice, world))


def field_path(choice: Choice, world: World) -> Path:
    """Where the learned field lies; raises UserError where there is none."""
    if choice.model == "learned":
        return weights.find(choice.models or weights.FOLDER, world, choice.asked)
    if (path := Path(choice.model)).suffix != ".safetensors":
        raise UserError(f"no model {choice.model!r}: give learned, exact, or a file of weights (.safetensors)")
    if not path.exists():
        made = weights.train_command(choice.asked, path.parent)
        raise UserError(f"--model {path}: there is no such file; {made} makes one, --model exact needs none")
    return path


def check(choice: Choice, world: World) -> None:
    """Raises UserError where `prepare` would for want of a model; nothing is compiled, so it is quick."""
    check_start(choice, world)
    if choice.estimator == "precise" and choice.model != "exact":
        weights.load(field_path(choice, world))
    elif choice.estimator == "paper":
        _paper_weights(choice, world)


def check_start(choice: Choice, world: World) -> None:
    """Raises UserError where the initial pose is off the map; a wall there may have been moved."""
    if choice.initial_pose is None:
        return
    x0, y0, x1, y1 = world.bounds
    x, y = map(float, choice.initial_pose[:2])
    if not (x0 <= x <= x1 and y0 <= y <= y1):
        raise UserError(
            f"initial pose ({x:g}, {y:g}) is off the map: {world.name} goes from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g})"
        )


def check_mount(geometry: Geometry, trained: Scanner) -> None:
    """Raises UserError where the mount is only assumed, and the weights were ``trained`` with another.

    A distance field predicts scans of a laser mounted anywhere, so a mount that is stated may differ.
    """
    off = geometry.mount - np.array(trained.mount)
    off[2] = se2.wrap(off[2])
    if geometry.mount_assumed and np.abs(off).max() > SAME_MOUNT:
        (here, there) = (f"{x:g},{y:g},{np.rad2deg(yaw):g}" for x, y, yaw in (geometry.mount, trained.mount))
        raise UserError(
            f"the scans do not state where the laser sits in base_link: {here} was assumed, but the weights were "
            f"trained with {there}; give --mount x,y[,yaw_deg] (for an imported recording, import its log again with "
            "--mount)"
        )


def _compile(model: GenerativeModel, seeds: Seeds, likelihood: Likelihood) -> None:
    """Once through every compiled loop, so that no scan waits for it."""
    angles = np.linspace(-1, 1, 16)
    view = View(model, likelihood, np.zeros(3), angles, np.ones(16), 25.0)
    polish(view, seeds.rank(view, 2), iterations=1)


def _paper(choice: Choice, world: World) -> Factory:
    # Torch takes a second to import; the other estimators do without.
    from services.estimator.paper import weights as paper_weights  # noqa: PLC0415
    from services.estimator.paper.beam_fitting import fit  # noqa: PLC0415
    from services.estimator.paper.decoder import use_one_core  # noqa: PLC0415
    from services.estimator.paper.estimator import PaperPerception  # noqa: PLC0415

    use_one_core()
    folder, known, remedy = _paper_weights(choice, world)
    without = remedy.rpartition(" --scanner")[0]
    for path in known.values():  # a broken file is found now, and torch is warm for the first scan
        model, card = paper_weights.load(path)
        if not weights.same_walls(card.world, world):
            raise UserError(
                f"{path} was trained in another world of the same name {world.name!r}: its walls differ. Give your "
                f"world a name of its own and train for it: {remedy}"
            )
        model.predict(np.array([*card.world.center(), card.heading]))
    load = functools.cache(paper_weights.load)  # one network, however many estimators are made

    def make(geometry: Geometry) -> Estimator:
        model, card = load(paper_weights.nearest(folder, world.name, "paper", len(geometry.angles)))
        check_mount(geometry, card.scanner)
        found = fit(card.scanner, geometry.angles, geometry.mount, f"{without} {_options(geometry)}")
        return PaperPerception(model, card, choice.descent, choice.initial_pose, found)

    return make


def _paper_weights(choice: Choice, world: World) -> tuple[Path, dict[int, Path], str]:
    """Folder, files by number of beams, and the command that makes them; raises UserError where there are none."""
    from services.estimator.paper import weights as paper_weights  # noqa: PLC0415 - torch, as above

    folder = choice.models or paper_weights.FOLDER
    known, remedy = (
        paper_weights.available(folder, world.name, "paper"),
        paper_weights.train_command(choice.asked, "paper"),
    )
    if not known:
        raise UserError(
            f"no weights of preset paper for world {world.name!r} in {folder}; make them with: {remedy}; "
            "preset precise does without, where told: --estimator precise --model exact"
        )
    return folder, known, remedy


def _options(geometry: Geometry) -> str:
    """Of `presage train`, for the scanner that gave these scans."""
    beams, (x, y, yaw) = len(geometry.angles), geometry.mount
    known = (
        name
        for name, one in SCANNERS.items()
        if np.allclose(one.with_beams(beams).angles(), geometry.angles, atol=1e-3)
    )
    return f"--scanner {next(known, 'FILE')} --beams {beams} --mount {x:g},{y:g},{np.rad2deg(yaw):g}"


def default_geometry(beams: int | None = None) -> Geometry:
    """Of the shipped scanner."""
    return Geometry.of(SCANNERS["tim571"].with_beams(beams))
