"""`presage train --from LOG`: trains on a drive with reference poses."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World, load_world, world_name
from common.robot.motion_distortion import beam_times, correct_beams, evenly_spaced
from common.robot.ranges import is_surface
from common.robot.robot import Robot
from common.robot.scan_geometry import Sweep
from common.robot.scanner import Scanner
from common.versions import commit, presage_command, versions
from presage.learning.field_figure import draw_model
from presage.logs.log import Reading
from presage.logs.scan_files import Scans, read_scans
from services.estimator.factory import ScannerGeometry
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.drive_learning import MIN_SCANS, LearningResult, learn_drive, replay_model
from services.estimator.precise.learning.field_learning import Recipe
from services.estimator.precise.learning.map_alignment import with_offset
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.generative_models import RayCaster
from services.estimator.shared.model_folder import training_folder

MIN_SCANS_OF_MAP, SCANS_PER_M2 = 500, 4  # scans simulated in a map: about 100 beams then meet each of its cells
MARGIN_M = 1.0  # of the rectangular world of a drive without a map, around the ends of the beams


@dataclass(frozen=True)
class TrainDriveOptions:
    """Options of `presage train --from`."""

    log: Path
    world: str = ""  # a map, in which scans are simulated for the places that the drive did not observe
    out: Path = field(default_factory=training_folder)
    samples: int = 2000  # number of simulated scans in the map; may be 0
    recipe: Recipe = Recipe(resolution=0.05)  # noqa: RUF009 - frozen
    share: float = 1.0  # of the drive to use, from its beginning
    reading: Reading | None = None  # properties of the log that the file does not state
    # If the drive refines a map, scans are simulated by its former model if there is one, else in the map.
    rough: World | None = None
    former: Path | None = None  # weights of the former model
    force: bool = False  # replace the weights of another world of the same name


def train_from_drive(options: TrainDriveOptions, console: Console) -> Path:
    """Trains a model on the drive, saves and draws it, and returns the path of the weights.

    Raises UserError if the log cannot be used or the weights cannot be saved.
    """
    scans = read_scans(options.log, reading=options.reading)
    scans.print_notes(console)
    drive = drive_of(scans, options.log)
    return train_on_drive(options, split(drive, options.share)[0], console)


def train_on_drive(options: TrainDriveOptions, drive: ReferenceDrive, console: Console) -> Path:
    """Trains a model on posed scans that were read from ``options.log``, as `train_from_drive` does."""
    if len(drive.ranges) < MIN_SCANS:
        raise UserError(
            f"{options.log}: {len(drive.ranges)} scans with a reference pose; training needs at least {MIN_SCANS}"
        )
    world = load_world(options.world) if options.world else rectangle(drive, options.log)
    path = weights.path_of(options.out, world.name)
    weights.refuse_to_overwrite(path, world, force=options.force)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    start = time.monotonic()
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("training", total=1.0)

        def report(title: str, done: float) -> None:
            bar.update(task, description=f"training: {title}", completed=done)

        simulated = None
        if options.former is not None:
            simulated = replayed_beams(options.former, drive, options.samples, options.recipe.seed)
        elif options.world and options.samples:
            model = with_offset(RayCaster(options.rough or world), drive)
            simulated = simulated_beams(model, drive, options.samples, options.recipe.seed)
        learned = learn_drive(drive, options.recipe, simulated, report, replayed=options.former is not None)
    card = card_of(options, world, drive, learned, time.monotonic() - start)
    weights.save(path, learned.model, learned.places, card)
    draw_model(weights.load(path)[0], card, path.with_suffix(".png"))
    console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, trained in {card.learning_s:.0f} s on {card.source}")
    for line in summary(card):
        console.print(line)
    return path


def drive_of(scans: Scans, log: Path) -> ReferenceDrive:
    """The scans with a reference pose, corrected for motion; raises UserError if there are none, or no stamps."""
    if scans.truth is None or not np.isfinite(scans.truth).all(axis=1).any():
        raise UserError(
            f"{log}: no reference poses, but training on a drive needs the pose of each scan in the map: use an .npz "
            "file with `reference`, a recording with the topic truth, or a log corrected by a mapping program"
        )
    if scans.stamps is None:
        raise UserError(f"{log}: no stamps, but they are needed to compute the velocity of the robot")
    use = usable_scans(scans.stamps, scans.truth)
    if not is_surface(scans.ranges[use]).any():
        raise UserError(f"{log}: no beam of the scans with a reference pose hit a surface")
    odom = None if scans.odom is None or not np.isfinite(scans.odom[use]).all(axis=1).any() else scans.odom
    whole = ReferenceDrive(
        scans.stamps,
        scans.truth,
        scans.ranges,
        scans.geometry.angles,
        scans.geometry.mount,
        scans.geometry.range_max,
        odom,
    )
    drive = whole.part(use)
    return replace(drive, ranges=_corrected_ranges(drive, scans.time_increment)) if scans.time_increment else drive


def usable_scans(stamps: Array, poses: Array) -> npt.NDArray[np.intp]:
    """Numbers (K,) of the scans of a drive that have a pose, of those in order of time."""
    latest = np.maximum.accumulate(stamps)  # stamps begin again where a simulation was restarted
    return np.flatnonzero(np.isfinite(poses).all(axis=1) & (stamps == latest))


def _corrected_ranges(drive: ReferenceDrive, time_increment: float) -> Array:
    """Ranges (N, B) m as if all beams of a scan had been measured at its stamp."""
    sweep, times = Sweep.of_angles(drive.angles), beam_times(len(drive.angles), time_increment)[:, None]
    motion, period = se2.between(drive.poses[:-1], drive.poses[1:]), np.diff(drive.stamps)
    # A sweep takes place after its stamp. Without time between two stamps, the velocity is unknown.
    velocities = np.zeros(drive.poses.shape)
    velocities[:-1] = motion / np.where(period > 0, period, np.inf)[:, None]
    corrected = (
        correct_beams(ranges, drive.angles, times * velocity, drive.mount)
        for ranges, velocity in zip(drive.ranges, velocities, strict=True)
    )
    return np.array([evenly_spaced(*each, sweep, -np.inf) for each in corrected])


def split(drive: ReferenceDrive, share: float = 0.5) -> tuple[ReferenceDrive, ReferenceDrive]:
    """The first ``share`` of the scans, rounded down, and the rest.

    All commands that train on one part of a drive and test on the other use this function, so that their parts agree.
    """
    numbers = np.arange(len(drive.ranges))
    first = numbers < int(share * len(numbers))
    return drive.part(numbers[first]), drive.part(numbers[~first])


def rectangle(drive: ReferenceDrive, log: Path) -> World:
    """A rectangular world around the ends of the beams, named after the log, for a drive without a map."""
    ends = Beams.of(drive.poses, drive.mount, drive.angles, drive.ranges).ends()
    (x0, y0), (x1, y1) = np.quantile(ends, (0.001, 0.999), axis=0) + MARGIN_M * np.array([[-1], [1]])
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    return World(name=world_name(log), boundary=[(round(float(x), 3), round(float(y), 3)) for x, y in corners])


def enough_scans(world: World) -> int:
    """Number of simulated scans without noise from which the field of a map is learned, by its free area."""
    return max(MIN_SCANS_OF_MAP, round(SCANS_PER_M2 * world.free_area))


def simulated_beams(model: RayCaster, drive: ReferenceDrive, samples: int, seed: int) -> Beams:
    """Scans of the drive's scanner at random free poses in the model's world, without noise."""
    rng = np.random.default_rng(seed)
    poses = model.world.sample_poses(samples, rng, Robot().radius)
    ranges = model.expect(se2.compose(poses, drive.mount), drive.angles).ranges
    return Beams.of(poses, drive.mount, drive.angles, np.where(ranges > drive.range_max, np.inf, ranges))


def replayed_beams(former: Path, drive: ReferenceDrive, samples: int, seed: int) -> Beams:
    """Scans of the drive's scanner as a former model predicts them, at random places that it knows."""
    model, seeds, _ = weights.load(former)
    return replay_model(model, seeds.places, drive, samples, seed)


def scanner_of(drive: ReferenceDrive, sigma: float, name: str) -> Scanner:
    """The scanner of a drive, for the model card; ``sigma`` is its range noise in m."""
    rate = float(1 / np.median(np.diff(drive.stamps)))
    return ScannerGeometry(drive.angles, drive.mount, drive.range_max, sigma).scanner(name, rate)


def card_of(
    options: TrainDriveOptions, world: World, drive: ReferenceDrive, learned: LearningResult, seconds: float
) -> weights.FieldCard:
    """The model card: the origin of the model and the results of its calibration."""
    calibration, errors = learned.calibration, learned.errors
    source = f"{len(drive.ranges)} posed scans of {options.log.name}"
    if options.world and options.samples:
        where = f"map {world.name}" if options.former is None else f"the former model {options.former.stem}"
        source = f"{source}; elsewhere {options.samples} simulated scans in {where}"
    return weights.FieldCard(
        world=world,
        scanner=scanner_of(drive, calibration.likelihood.sigma, options.log.stem),
        samples=len(drive.ranges),
        seed=options.recipe.seed,
        resolution=options.recipe.resolution,
        origin=learned.model.field.origin,
        sweeps=options.recipe.sweeps,
        inflation=calibration.inflation,
        test_samples=calibration.scans,
        test_range_error_median_m=float(np.median(errors)),
        test_range_error_mean_m=float(errors.mean()),
        test_share_above_5_cm=float((errors > 0.05).mean()),
        test_position_error_rms_m=float(np.hypot(calibration.floor_position, calibration.floor_position)),
        learning_s=round(seconds, 1),
        source=source,
        calibration=calibration,
        commit=commit(),
        command=presage_command(),
        versions=versions(),
    )


def summary(card: weights.FieldCard) -> list[str]:
    """The results of the calibration as lines for the terminal."""
    calibration = card.calibration
    if calibration is None:
        return []
    likelihood = calibration.likelihood
    return [
        (
            f"held out: {calibration.scans} scans, {calibration.log_likelihood:.3f} nats per beam; range error median "
            f"{card.test_range_error_median_m * 1e3:.1f} mm, {card.test_share_above_5_cm:.1%} above 5 cm"
        ),
        (
            f"beams: {likelihood.short:.1%} too short, {likelihood.random:.1%} random, {likelihood.unseen:.1%} without "
            f"return; noise {likelihood.sigma * 1e3:.1f} mm; usually {calibration.usual:.0%} of a scan is explained"
        ),
        (
            f"pose from one scan against that of the drive: error floor {calibration.floor_position * 1e3:.0f} mm and "
            f"{np.rad2deg(calibration.floor_heading):.2f} deg, covariance scaled by {calibration.inflation:.1f}; NEES "
            f"then {calibration.nees_median:.2f} median (ideal: 2.37), {calibration.nees_mean:.2f} mean (ideal: 3)"
        ),
    ]
