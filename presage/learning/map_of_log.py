"""`presage map`: builds a ROS map from a drive, with poses from the scans themselves or from the log.

A cell is occupied if beams of at least `MIN_HITS` scans ended in it, and of at least `MIN_HIT_SHARE` of the scans that
observed it; otherwise it is free if a beam passed through it, and unknown if not. Beams mostly pass through the places
of moving objects, which therefore become free. Beams without return are not used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress, track

from common.errors import UserError
from common.geometry import se2
from common.geometry.occupancy_grid import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, Cells
from common.geometry.se2 import Array
from common.robot.ranges import is_surface
from presage.learning.grid_map import write_map
from presage.learning.map_picture import draw_map
from presage.learning.train_drive import drive_of, split
from presage.logs.log import Reading
from presage.logs.scan_files import Scans, read_scans
from presage.mapping.drive import RawDrive
from presage.mapping.slam import build_trajectory
from presage.recordings.tum import write_tum
from presage.terminal.output import make_folder
from services.estimator.precise.learning.calibration import Drive
from services.estimator.precise.learning.surfaces import Beams, has_neighbours

# With a smaller share, noise makes walls grow towards the scanner; with a larger one, corners disappear.
MIN_HITS, MIN_HIT_SHARE = 2, 0.6
MARGIN_M = 0.5  # around the observed area
MIN_SCANS = 2


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


def map_command(options: MapOptions, console: Console, progress: Console) -> Path:
    """Writes the map and its image, and returns its path; raises UserError if that fails."""
    if options.half not in ("", "first", "second"):
        raise UserError(f"no half {options.half!r}: choose first or second, or leave out --half")
    if options.poses not in ("slam", "reference"):
        raise UserError(f"no poses {options.poses!r}: choose slam or reference with --poses")
    if options.out.suffix != ".yaml":
        raise UserError(f"--out {options.out}: give NAME.yaml; the image is written beside it")
    image, trajectory, picture = (options.out.with_suffix(suffix) for suffix in (".pgm", ".tum", ".png"))
    if existing := next((path for path in (options.out, image, trajectory, picture) if path.exists()), None):
        raise UserError(f"{existing} exists already: choose another name with --out, or remove it")
    make_folder(options.out.parent, "--out")
    scans = read_scans(options.log, reading=options.reading)
    scans.print_notes(progress)
    stamps = scans.stamps
    if stamps is None:  # not needed for a map, but for a drive
        stamps = np.arange(len(scans.ranges), dtype=np.float64)
    scans = replace(scans, stamps=stamps)
    if options.poses == "slam":
        scans = replace(scans, truth=_build_poses(scans, stamps, options, console, progress))
    drive = drive_of(scans, options.log)
    if options.half:
        drive = split(drive)[0 if options.half == "first" else 1]
    values, origin = cells_of(drive, options.cell, progress)
    keys = {"resolution": options.cell, "origin": [round(origin[0], 6), round(origin[1], 6), 0.0]}
    path = write_map(options.out.parent, values, name=options.out.stem, image=image.name, **keys)
    write_tum(trajectory, drive.stamps, drive.poses)
    draw_map(picture, values, origin, options.cell, drive.poses)
    rows, columns = values.shape
    console.print(
        f"{path}: {columns} x {rows} cells of {options.cell:g} m from {len(drive.ranges)} scans; "
        f"{(values == OCCUPIED).mean():.0%} occupied, {(values == FREE).mean():.0%} free",
        soft_wrap=True,
    )
    return path


def _build_poses(scans: Scans, stamps: Array, options: MapOptions, console: Console, progress: Console) -> Array:
    """Poses (N, 3) computed from the scans."""
    if len(scans) < MIN_SCANS:
        raise UserError(f"{options.log}: {len(scans)} scans; a map needs at least {MIN_SCANS}")
    geometry = scans.geometry
    complete = scans.odom is not None and bool(np.isfinite(scans.odom).all())
    odom = scans.odom if options.odometry and complete else None
    drive = RawDrive(stamps, scans.ranges, geometry.angles, geometry.mount, geometry.range_max, odom)
    with Progress(*Progress.get_default_columns(), console=progress, transient=True) as bar:
        task = bar.add_task("mapping", total=1.0)

        def report(title: str, done: float) -> None:
            bar.update(task, description=title, completed=done)

        built = build_trajectory(drive, report)
    console.print(
        f"{len(built.keys)} key scans, {len(built.closures)} loop closures, {built.lost} scans that matched nothing "
        f"before; {'with' if odom is not None else 'without'} odometry",
        soft_wrap=True,
    )
    return built.poses


def cells_of(drive: Drive, cell: float, progress: Console | None = None) -> tuple[Cells, tuple[float, float]]:
    """Cells (rows, columns) of edge length ``cell`` m, lowest row first, and x, y m of the lower left corner.

    Raises UserError if there are too many cells.
    """
    beams = Beams.of(drive.poses, drive.mount, drive.angles, drive.ranges)
    ends = beams.ends()
    seen = np.concatenate([ends[has_neighbours(ends)], drive.poses[:, :2]])
    corner = np.floor((seen.min(axis=0) - MARGIN_M) / cell) * cell
    columns, rows = (int(n) for n in np.ceil((seen.max(axis=0) + MARGIN_M - corner) / cell))
    if columns * rows > MAX_CELLS:
        raise UserError(
            f"{columns} x {rows} cells are more than the maximum of {MAX_CELLS}: use a larger --cell than {cell:g} m"
        )
    hits, passes = np.zeros(rows * columns, np.int64), np.zeros(rows * columns, np.int64)
    lasers = se2.compose(drive.poses, drive.mount)
    for laser, ranges in track(
        list(zip(lasers, drive.ranges, strict=True)),
        "mapping",
        console=progress,
        transient=True,
        disable=progress is None,
    ):
        hit, passed = (
            _cell_indices(points, corner, cell, rows, columns) for points in _beam_points(laser, ranges, drive, cell)
        )
        hits[hit] += 1
        passes[np.setdiff1d(passed, hit, assume_unique=True)] += 1
    occupied = (hits >= MIN_HITS) & (hits >= MIN_HIT_SHARE * (hits + passes))
    values = np.where(occupied, OCCUPIED, np.where(passes > 0, FREE, UNKNOWN)).astype(np.uint8)
    return values.reshape(rows, columns), (float(corner[0]), float(corner[1]))


def _beam_points(laser: Array, ranges: Array, drive: Drive, cell: float) -> tuple[Array, Array]:
    """Ends of the beams (K, 2) m in map, and points (L, 2) along them, half a cell apart."""
    hit = is_surface(ranges) & (ranges < drive.range_max)
    ranges = ranges[hit]
    angles = laser[2] + drive.angles[hit]
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    distances = np.arange(0.0, ranges.max(initial=0.0), cell / 2)
    beam, step = np.nonzero(distances < ranges[:, None])
    return laser[:2] + ranges[:, None] * unit, laser[:2] + distances[step, None] * unit[beam]


def _cell_indices(points: Array, corner: Array, cell: float, rows: int, columns: int) -> npt.NDArray[np.int64]:
    """Flat indices of the cells that contain points (K, 2) m, each once."""
    column, row = np.floor((points - corner) / cell).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return np.unique(row[inside] * columns + column[inside])
