"""`presage map`: builds a ROS map and the model from a drive, with poses from the scans themselves or from the log."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from common.errors import UserError
from common.geometry.occupancy_grid import FREE, OCCUPIED
from common.geometry.rasterisation import rasterise
from common.geometry.ros_map_writer import write_grid
from common.geometry.se2 import Array
from common.geometry.tum import write_tum
from common.geometry.world import World, load_world, world_name
from common.writing import complete_files
from presage.learning.map_picture import draw_map
from presage.learning.odometry_check import odometry_warnings
from presage.learning.placement import place_drive
from presage.learning.pose_refinement import refine_poses
from presage.learning.train_drive import TrainDriveOptions, drive_of, enough_scans, split, train_on_drive, usable_scans
from presage.logs.log import Reading
from presage.logs.scan_files import Scans, read_scans
from presage.terminal.output import output_folder
from presage.terminal.progress import working
from services.estimator.precise.learning import drive_learning, weights
from services.mapper.slam.drive import Laser, RawDrive
from services.mapper.slam.grid import grid_of_scans
from services.mapper.slam.trajectory import DriveTrajectory, build_trajectory, distribute_corrections

MIN_SCANS_FOR_SLAM = 2


@dataclass(frozen=True)
class MapOptions:
    """Options of `presage map`."""

    log: Path
    out: Path  # NAME.yaml
    half: str = ""  # first or second; defaults to the whole drive
    cell: float = 0.05  # m
    reading: Reading | None = None
    poses: str = "slam"  # slam: from scans and odometry; reference: the log's own
    odometry: bool = True  # whether slam uses the log's odometry
    refine: str = ""  # map whose frame is kept, and what the drive did not see of it and its model; only with slam
    models: Path | None = None  # folder for the weights of the model; defaults to no model


def map_command(options: MapOptions, console: Console, progress: Console) -> Path:
    """Writes the map and its image, and returns its path; raises UserError if that fails."""
    _check(options)
    with ExitStack() as folders:
        folders.enter_context(output_folder(options.out.parent))
        if options.models is not None:
            folders.enter_context(output_folder(options.models, "--models"))
        return _write_map(options, console, progress)


def _write_map(options: MapOptions, console: Console, progress: Console) -> Path:
    rough = load_world(options.refine) if options.refine else None
    former = None if rough is None else _model_of(rough, options)
    scans = read_scans(options.log, reading=options.reading)
    scans.print_notes(progress)
    stamps = scans.stamps
    if stamps is None:  # not needed for a map, but for a drive
        trajectory = options.out.with_suffix(".tum")
        note = f"the scans have no stamps: they are taken to be 1 s apart, also in {trajectory}"
        progress.print(note, highlight=False, soft_wrap=True)
        stamps = np.arange(len(scans.ranges), dtype=np.float64)
    scans = replace(scans, stamps=stamps)
    _check_scan_count(len(scans), options)  # now, because the poses take a while
    if options.poses == "slam":
        scans = replace(scans, truth=_build_poses(scans, stamps, rough, former, options, console, progress))
    drive = drive_of(scans, options.log)
    if options.half:
        drive = split(drive)[0 if options.half == "first" else 1]
    _check_scan_count(len(drive.ranges), options)  # of the half, before anything is written
    laser = Laser(drive.angles, drive.mount, drive.range_max)
    unseen = None if rough is None else rasterise(rough, options.cell)
    grid = grid_of_scans(drive.poses, drive.ranges, laser, options.cell, unseen)
    path = options.out
    with complete_files(path) as partial:
        write_grid(partial, path.stem, grid)
        write_tum(partial / f"{path.stem}.tum", drive.stamps, drive.poses)
        draw_map(partial / f"{path.stem}.png", grid, drive.poses)
    console.print(
        f"{path}: {grid.width} x {grid.height} cells of {options.cell:g} m from {len(drive.ranges)} scans; "
        f"{(grid.values == OCCUPIED).mean():.0%} occupied, {(grid.values == FREE).mean():.0%} free",
        soft_wrap=True,
    )
    if options.models is not None:
        # Where the drive saw nothing, the model learns from scans simulated in the rough map.
        samples = 0 if rough is None else enough_scans(rough)
        training = TrainDriveOptions(options.log, str(path), options.models, samples, rough=rough, former=former)
        weights_file = train_on_drive(training, drive, console)
        console.print(f"use them with --world {path} --model {weights_file}", soft_wrap=True)
    return path


def raw_drive(scans: Scans, stamps: Array, odom: Array | None) -> RawDrive:
    """The scans of a log as a drive, with the times (N,) and the odometry (N, 3) to use."""
    geometry = scans.geometry
    laser = Laser(geometry.angles, geometry.mount, geometry.range_max, scans.time_increment)
    return RawDrive(stamps, scans.ranges, laser, odom)


def _check(options: MapOptions) -> None:
    """Raises UserError if an option is wrong, or a file would be overwritten."""
    if options.half not in ("", "first", "second"):
        raise UserError(f"no half {options.half!r}: choose first or second, or leave out --half")
    if options.poses not in ("slam", "reference"):
        raise UserError(f"no poses {options.poses!r}: choose slam or reference with --poses")
    if options.out.suffix != ".yaml":
        raise UserError(f"--out {options.out}: give NAME.yaml; the image is written beside it")
    if options.refine and options.poses == "reference":
        raise UserError("--refine computes the poses from the scans: leave out --poses reference")
    files = [options.out.with_suffix(suffix) for suffix in (".yaml", ".pgm", ".tum", ".png")]
    if options.models is not None:
        files.append(weights.path_of(options.models, world_name(options.out)))
    if existing := [str(path) for path in files if path.exists()]:
        raise UserError(f"exists already: {', '.join(existing)}; choose another name with --out, or delete these files")


def _check_scan_count(count: int, options: MapOptions) -> None:
    """Raises UserError if so many scans are too few for a model."""
    least = drive_learning.MIN_SCANS
    if options.models is not None and count < least:
        problem = f"{count} scans to learn from; a model needs at least {least}"
        raise UserError(f"{options.log}: {problem}: add --no-learn for the map alone")


def _model_of(rough: World, options: MapOptions) -> Path | None:
    """The file of the model that belongs to the map to refine, or None if it has none.

    Raises UserError if the file is damaged, or belongs to another map of the same name.
    """
    if options.models is None or not weights.path_of(options.models, rough.name).exists():
        return None
    return weights.find(options.models, rough, options.refine)


def _build_poses(
    scans: Scans,
    stamps: Array,
    rough: World | None,
    former: Path | None,
    options: MapOptions,
    console: Console,
    progress: Console,
) -> Array:
    """Poses (N, 3) computed from the scans, in the frame of the map ``rough`` if given, otherwise of the first scan."""
    built = _build_trajectory(scans, stamps, options, console, progress)
    posed = drive_of(replace(scans, truth=built.poses), options.log)
    used = usable_scans(stamps, built.poses)
    with Progress(*Progress.get_default_columns(), console=progress, transient=True) as bar:
        task = bar.add_task("refining the poses", total=1.0)
        poses: Array = built.poses.copy()
        poses[used] = refine_poses(posed, lambda done: bar.update(task, completed=done))
    if rough is None:
        return poses
    posed = replace(posed, poses=poses[used])
    keys = np.intersect1d(built.keys, used)
    with working(f"finding the drive in {rough.name}", progress):
        placement = place_drive(rough, posed.part(np.searchsorted(used, keys)), former)
    console.print(
        f"{placement.found:.0%} of the key scans found in {rough.name}, with a median deviation of "
        f"{placement.deviation * 1e3:.0f} mm",
        soft_wrap=True,
    )
    if placement.scale != 1:
        size = f"{100 * abs(placement.scale - 1):.1g}% {'larger' if placement.scale > 1 else 'smaller'}"
        warning = f"warning: {rough.name} is about {size} than the drive: is its resolution right?"
        progress.print(warning, highlight=False, soft_wrap=True)
    return distribute_corrections(poses, keys, placement.poses, np.zeros(len(keys), int))


def _build_trajectory(
    scans: Scans, stamps: Array, options: MapOptions, console: Console, progress: Console
) -> DriveTrajectory:
    """Matches the scans with one another, and prints the result."""
    if len(scans) < MIN_SCANS_FOR_SLAM:
        raise UserError(f"{options.log}: {len(scans)} scans; a map needs at least {MIN_SCANS_FOR_SLAM}")
    odom = scans.odom if options.odometry else None
    with_odometry = 0 if odom is None else int(np.isfinite(odom).all(axis=1).sum())
    drive = raw_drive(scans, stamps, odom)
    with Progress(*Progress.get_default_columns(), console=progress, transient=True) as bar:
        task = bar.add_task("mapping", total=1.0)

        def report(title: str, done: float) -> None:
            bar.update(task, description=title, completed=done)

        built = build_trajectory(drive, report)
    console.print(
        f"{len(built.keys)} key scans, {len(built.closures)} loop closures, "
        f"{built.unmatched} scans that did not match those before; {_odometry_note(with_odometry, len(scans))}",
        soft_wrap=True,
    )
    if odom is not None:
        for warning in odometry_warnings(built.poses[built.keys], odom[built.keys]):
            progress.print(f"warning: {warning}", highlight=False, soft_wrap=True)
    unplaced = float(np.isnan(built.poses).any(axis=1).mean())
    if unplaced:
        causes = "the robot was carried away, or its view was blocked"
        if not with_odometry:
            rate = 1 / np.median(np.diff(stamps))
            causes += f", or it moved too far between two scans ({rate:.3g} per second, without odometry)"
        console.print(
            f"{unplaced:.1%} of the scans are left out: they contradict what was seen just before, or match it at "
            f"several places, and were not found elsewhere in the map; {causes}",
            soft_wrap=True,
        )
    return built


def _odometry_note(known: int, count: int) -> str:
    if not known:
        return "without odometry"
    return "with odometry" if known == count else f"with odometry for {known} of {count} scans"
