"""Builds an estimator and its model from their names, and opens the files of the model."""

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
from common.packages import explain_missing_packages
from common.robot.scanner import SCANNERS, Scanner
from services.estimator.paper.perception import Descent
from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.sensor import Sensor
from services.estimator.particle_filter.settings import ParticleFilterSettings
from services.estimator.precise.estimator import PreciseEstimator
from services.estimator.precise.gauss_newton import Optimiser
from services.estimator.precise.global_seeds import SEED_SPACING_M, Seeds, thin_places
from services.estimator.precise.learning import weights
from services.estimator.precise.likelihood import Likelihood, check_likelihood
from services.estimator.precise.motion_model import MotionNoise
from services.estimator.precise.settings import PreciseSettings
from services.estimator.shared.generative_models import GenerativeModel, RayCaster, check_model
from services.estimator.shared.interface import Observation, PoseEstimator
from services.estimator.shared.model_folder import find_folder

DEFAULT_SIGMA_M = 0.02  # noise of a scanner whose scans state none
MOUNT_TOLERANCE = 1e-3  # m and rad
MIN_SIGMA_M = 1e-3  # lower limit of the noise that scans state, because no surface is known more exactly
EstimatorPreset = Literal["precise", "paper", "particle-filter", "amcl-defaults"]


@dataclass(frozen=True)
class EstimatorOptions:
    """Selects an estimator, its model and its parameters."""

    world: str | World = "corridor"  # name of a shipped world, path of a file, or the world itself
    estimator: EstimatorPreset = "precise"
    model: str = "learned"  # for precise: learned, exact, or a file of weights
    models: Path | None = None  # folder of weights; defaults to the user's for this world, else the shipped ones
    sigma: float | None = None  # m, the scanner's noise; defaults to what the scans state, else DEFAULT_SIGMA_M
    seed: int = 0
    initial_pose: Array | None = None  # (3,), or (2,) without heading; None if unknown (paper starts at the centre)
    descent: Descent = Descent()  # noqa: RUF009 - frozen; for paper
    generative_model: GenerativeModel | None = None  # for precise: used instead of `model`
    likelihood: Likelihood | None = None  # for precise; defaults to the weights' calibration or the noise
    optimiser: Optimiser | None = None  # for precise; defaults to Gauss-Newton
    motion: MotionNoise = MotionNoise()  # noqa: RUF009 - frozen; for precise, unless the weights are calibrated

    @functools.cached_property
    def loaded_world(self) -> World:
        """The world itself; raises UserError if its file is missing or invalid."""
        return self.world if isinstance(self.world, World) else load_world(self.world)

    @property
    def world_argument(self) -> str:
        """The world as it would be given on the command line."""
        if isinstance(self.world, str):
            return self.world
        return self.world.name if self.world.name in known_worlds() else f"{self.world.name}.yaml"  # from a recording


@dataclass(frozen=True)
class ScannerGeometry:
    """Beams, mount and noise of a scanner's scans."""

    angles: Array  # (B,) rad in laser
    mount: Array  # (3,) laser in base_link
    range_max: float  # m
    sigma: float = 0.0  # m, the scanner's noise
    sigma_relative: float = 0.0  # noise that grows with the range, as a fraction of the range; both 0 if not stated
    mount_assumed: bool = False  # whether the mount is a guess, because neither the scans nor the user state it

    @classmethod
    def of(cls, scanner: Scanner) -> ScannerGeometry:
        """The geometry of a scanner's scans."""
        mount = np.array(scanner.mount)
        return cls(scanner.angles(), mount, scanner.range_max, scanner.sigma, scanner.sigma_relative)

    @classmethod
    def of_scan(cls, scan: Scan) -> ScannerGeometry:
        """The geometry of a scan message."""
        return cls(scan.angles(), scan.mount.array(), scan.range_max, scan.sigma, scan.sigma_relative)

    def same(self, other: ScannerGeometry, *, bound_to_beams: bool) -> bool:
        """Whether an estimator that was built for this geometry can process scans of the ``other`` one.

        An estimator that is ``bound_to_beams`` needs the same angles. Others do not, because some scanners measure a
        slightly different number of beams in each turn.
        """
        noise = (self.sigma, self.sigma_relative) == (other.sigma, other.sigma_relative)
        if not noise or not np.allclose(self.mount, other.mount, atol=1e-4):
            return False
        if not bound_to_beams:
            return True
        return len(self.angles) == len(other.angles) and np.allclose(self.angles, other.angles, atol=1e-4)

    def upside_down(self) -> ScannerGeometry:
        """The geometry of the scanner mounted upside down (a roll of 180 deg), which reverses the order of beams."""
        return replace(self, angles=-self.angles)

    def scanner(self, name: str, rate: float = 1 / MotionNoise.period) -> Scanner:
        """A scanner with this geometry, for the model card; ``rate`` is in Hz."""
        angles = self.angles
        x, y, yaw = map(float, self.mount)
        return Scanner(
            name=name,
            beams=len(angles),
            fov=min(float(abs(angles[-1] - angles[0])), 2 * np.pi),
            rate=rate,
            range_min=0.0,
            range_max=self.range_max,
            sigma=self.sigma,
            sigma_relative=self.sigma_relative,
            mount=(x, y, yaw),
            first=float(-angles[0] if angles[-1] < angles[0] else angles[0]),
            upside_down=bool(angles[-1] < angles[0]),
        )

    def likelihood(self, sigma: float | None = None) -> Likelihood:
        """The likelihood with noise ``sigma`` m, by default the noise that the scans state, or `DEFAULT_SIGMA_M`."""
        if sigma is not None:
            return Likelihood(sigma)
        if not self.sigma and not self.sigma_relative:
            return Likelihood(DEFAULT_SIGMA_M)
        return Likelihood(max(self.sigma, MIN_SIGMA_M), relative=self.sigma_relative)


EstimatorFactory = Callable[[ScannerGeometry], PoseEstimator]


def prepare_factory(options: EstimatorOptions) -> EstimatorFactory:
    """Loads the world and the weights, and returns a factory of estimators for the geometry of the first scan.

    Raises UserError now, and not at the first scan, if something is missing or wrong.
    """
    if options.estimator not in get_args(EstimatorPreset):
        raise UserError(f"no estimator {options.estimator!r}: choose one of {', '.join(get_args(EstimatorPreset))}")
    if options.sigma is not None and not 0 < options.sigma < np.inf:
        raise UserError(f"sigma: give the noise of the scanner in m, greater than 0, not {options.sigma}")
    if options.estimator != "precise" and (options.likelihood is not None or options.optimiser is not None):
        raise UserError(f"likelihood and optimiser are for preset precise only, not {options.estimator}")
    if options.likelihood is not None:
        check_likelihood(options.likelihood)
        if options.sigma is not None:
            raise UserError("give sigma or likelihood, not both: the likelihood has a sigma of its own")
    if options.optimiser is not None and not hasattr(options.optimiser, "descend"):
        raise UserError(f"optimiser: give an object with the method descend, not {options.optimiser!r}")
    world = options.loaded_world
    check_start(options.initial_pose, world)
    if options.estimator == "paper":
        return _prepare_paper(options, world)
    if options.estimator == "precise":
        return _prepare_precise(options, world)
    return _prepare_particle_filter(options, world)


def _prepare_particle_filter(options: EstimatorOptions, world: World) -> EstimatorFactory:
    tuned = options.estimator == "particle-filter"
    settings = ParticleFilterSettings.tuned() if tuned else ParticleFilterSettings()
    world.ray_distances(np.zeros((1, 3)), np.zeros(1))  # compile now, so that no request has to wait
    sensor = functools.cache(lambda: Sensor(world, settings))  # all filters share one field

    def make(geometry: ScannerGeometry) -> PoseEstimator:
        x, y, yaw = map(float, geometry.mount)
        estimator = ParticleFilter(world, settings, (x, y, yaw), options.seed, sensor=sensor())
        estimator.name = options.estimator
        if options.initial_pose is not None:
            estimator.restart(options.initial_pose)
        return estimator

    return make


def _prepare_precise(options: EstimatorOptions, world: World) -> EstimatorFactory:
    model, seeds, card = load_model(options, world)
    calibration = card.calibration if card else None
    if calibration:
        settings = calibration.settings()
    else:
        settings = PreciseSettings(inflation=card.inflation if card else 1.0, motion=options.motion)
    measured = card is not None and (card.measured or card.calibration is not None)
    cell = 0.0 if measured or world.grid is None else world.grid.resolution
    bounds = (card.world if card else world).bounds
    _compile(model, seeds)

    def make(geometry: ScannerGeometry) -> PoseEstimator:
        if card:
            check_mount(geometry, card.scanner)
        if options.likelihood is not None:
            likelihood = options.likelihood
        elif calibration and options.sigma is None:
            likelihood = calibration.likelihood
        else:
            likelihood = geometry.likelihood(options.sigma)
        rng = np.random.default_rng(options.seed)
        estimator = PreciseEstimator(
            model, seeds, geometry.mount, likelihood, settings, rng, bounds, options.optimiser, cell
        )
        if options.initial_pose is not None:
            estimator.restart(options.initial_pose)
        return estimator

    return make


def load_model(options: EstimatorOptions, world: World) -> tuple[GenerativeModel, Seeds, weights.FieldCard | None]:
    """Returns the model, the seeds of a search, and the card of a learned model, else None."""
    if options.generative_model is None and options.model != "exact":
        return weights.load(field_path(options, world))
    # The robot may be where an obstacle of the map was removed. A grid does not tell walls from furniture.
    count, rng = max(4000, int(60 * world.free_area)), np.random.default_rng(0)
    places = world.sample_within_walls(count, rng) if world.grid is None else world.sample_free(count, rng, 0.05)
    model: GenerativeModel = RayCaster(world)
    if options.generative_model is not None:
        model = options.generative_model
        check_model(model, places[:2])
    return model, Seeds.at(model, thin_places(places, SEED_SPACING_M)), None


def field_path(options: EstimatorOptions, world: World) -> Path:
    """The weights file of the learned field. Raises UserError if there is none."""
    if options.model == "learned":
        return weights.find(options.models or find_folder(world.name, "precise"), world, options.world_argument)
    if (path := Path(options.model)).suffix != ".safetensors":
        raise UserError(f"no model {options.model!r}: give learned, exact, or a file of weights (.safetensors)")
    if not path.exists():
        command = weights.train_command(options.world_argument, path.parent)
        raise UserError(
            f"--model {path}: there is no such file. Train it with: {command}; or use --model exact, which needs no "
            "weights"
        )
    return path


def check_options(options: EstimatorOptions, world: World) -> None:
    """Raises UserError if a model is missing, as `prepare_factory` does, but without compiling anything."""
    check_start(options.initial_pose, world)
    if options.estimator == "precise" and options.model != "exact":
        weights.load(field_path(options, world))
    elif options.estimator == "paper":
        _paper_weights(options, world)


def check_start(pose: Array | None, world: World) -> None:
    """Raises UserError if the initial ``pose`` (3,) or (2,) is off the map.

    A pose inside a wall is accepted, because the wall may have been moved.
    """
    if pose is None:
        return
    x0, y0, x1, y1 = world.bounds
    x, y = map(float, pose[:2])
    if not (x0 <= x <= x1 and y0 <= y <= y1):
        raise UserError(
            f"initial pose ({x:g}, {y:g}) is off the map: {world.name} goes from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g})"
        )


def check_mount(geometry: ScannerGeometry, trained: Scanner) -> None:
    """Raises UserError if the mount is only assumed, and the weights were ``trained`` with another mount.

    A mount that is stated may differ, because a distance field predicts scans for any mount.
    """
    difference = np.abs(se2.difference(geometry.mount, np.array(trained.mount)))
    if geometry.mount_assumed and difference.max() > MOUNT_TOLERANCE:
        assumed, stated = (f"{x:g},{y:g},{np.rad2deg(yaw):g}" for x, y, yaw in (geometry.mount, trained.mount))
        raise UserError(
            f"the scans do not state where the laser sits in base_link: {assumed} was assumed, but the weights were "
            f"trained with {stated}; give --mount x,y[,yaw_deg] (for an imported recording, import its log again with "
            "--mount)"
        )


def _compile(model: GenerativeModel, seeds: Seeds) -> None:
    """Runs an estimator on a few scans, so that all numba functions are compiled before the first real scan."""
    estimator = PreciseEstimator(model, Seeds(seeds.places[:4], seeds.panoramas[:4]), np.zeros(3))
    angles, beam = np.linspace(-1, 1, 32), np.arange(32)
    ranges = estimator.predict(np.array([[*seeds.places[0], 0.0]]), angles).ranges[0]
    ranges[7] = np.inf
    for stamp, moved in enumerate((0.0, 0.01, 1.0)):  # in the last scan, an obstacle is 1 m before the walls
        estimator.update(Observation(ranges - moved * (beam % 16 < 5), angles, 25.0, 0.07 * stamp))


@explain_missing_packages()
def _prepare_paper(options: EstimatorOptions, world: World) -> EstimatorFactory:
    # Imported only here, because torch takes a second to import and the other estimators do not need it.
    from services.estimator.paper import weights as paper_weights
    from services.estimator.paper.beam_fitting import fit
    from services.estimator.paper.decoder import use_one_core
    from services.estimator.paper.estimator import PaperEstimator

    use_one_core()
    folder, files, remedy = _paper_weights(options, world)
    for path in files.values():  # find damaged files now, and warm up torch for the first scan
        model, card = paper_weights.load(path)
        if not weights.same_walls(card.world, world):
            raise UserError(
                f"{path} was trained in another world of the same name {world.name!r}: its walls differ. Rename your "
                f"world and train for it: {remedy}"
            )
        model.predict(np.array([*card.world.center(), card.heading]))
    load = functools.cache(paper_weights.load)  # all estimators share one network

    def make(geometry: ScannerGeometry) -> PoseEstimator:
        model, card = load(paper_weights.nearest(folder, world.name, len(geometry.angles)))
        check_mount(geometry, card.scanner)
        train_command = paper_weights.train_command(options.world_argument, _train_options(geometry))
        converted = fit(card.scanner, geometry.angles, geometry.mount, train_command)
        return PaperEstimator(model, card, options.descent, options.initial_pose, converted)

    return make


@explain_missing_packages()
def _paper_weights(options: EstimatorOptions, world: World) -> tuple[Path, dict[int, Path], str]:
    """Returns the folder, its files by number of beams, and the command that trains them.

    Raises UserError if there are none.
    """
    from services.estimator.paper import weights as paper_weights  # torch, as above

    folder = options.models or find_folder(world.name, "paper")
    files = paper_weights.available(folder, world.name)
    remedy = paper_weights.train_command(options.world_argument)
    if not files:
        raise UserError(
            f"no weights of preset paper for world {world.name!r} in {folder}; train them with: {remedy}; "
            "or use --estimator precise --model exact, which needs no weights"
        )
    return folder, files, remedy


def _train_options(geometry: ScannerGeometry) -> str:
    """Options of `presage train` for the scanner of these scans."""
    beams, (x, y, yaw) = len(geometry.angles), geometry.mount
    matching = (
        name
        for name, scanner in SCANNERS.items()
        if np.allclose(scanner.with_beams(beams).angles(), geometry.angles, atol=1e-3)
    )
    return f"--scanner {next(matching, 'FILE')} --beams {beams} --mount {x:g},{y:g},{np.rad2deg(yaw):g}"
