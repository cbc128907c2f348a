"""`presage map`: a ROS map from a drive with known poses.

A cell is occupied where at least `LEAST` scans ended and at least `SHARE` of the scans that looked at it; else free
where one went through, else unknown. What moves was mostly looked through. Beams without return say nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track

from common.errors import UserError
from common.geometry import se2
from common.geometry.occupancy_grid import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, Cells
from common.geometry.se2 import Array
from common.robot.ranges import surfaces
from presage.learning.grid_map import write_map
from presage.learning.train_drive import drive_of, split
from presage.logs.log import Reading
from presage.logs.scan_files import read_scans
from presage.terminal.output import make_folder
from services.estimator.precise.learning.calibration import Drive
from services.estimator.precise.learning.surfaces import Beams, has_neighbours

LEAST, SHARE = 2, 0.6  # less, and noise lets walls grow towards the scanner; more, and corners wear away
MARGIN = 0.5  # m around what was seen


@dataclass(frozen=True)
class MapOptions:
    """What to map."""

    log: Path
    out: Path  # NAME.yaml
    half: str = ""  # first or second; none: the whole drive
    cell: float = 0.05  # m
    reading: Reading | None = None


def map_command(job: MapOptions, console: Console, progress: Console) -> Path:
    """Write map.yaml and its image; raises UserError in one line."""
    if job.half not in ("", "first", "second"):
        raise UserError(f"no half {job.half!r}: choose first or second, or leave out --half")
    if job.out.suffix != ".yaml":
        raise UserError(f"--out {job.out}: give NAME.yaml; the image is written beside it")
    image = job.out.with_suffix(".pgm")
    if there := next((path for path in (job.out, image) if path.exists()), None):
        raise UserError(f"{there} is there already: --out another name, or remove it")
    make_folder(job.out.parent, "--out")
    scans = read_scans(job.log, reading=job.reading)
    scans.print_notes(progress)
    if scans.stamps is None:  # a map needs none
        scans = replace(scans, stamps=np.arange(len(scans.ranges), dtype=np.float64))
    drive = drive_of(scans, job.log)
    if job.half:
        drive = split(drive)[0 if job.half == "first" else 1]
    values, origin = cells_of(drive, job.cell, progress)
    keys = {"resolution": job.cell, "origin": [round(origin[0], 6), round(origin[1], 6), 0.0]}
    path = write_map(job.out.parent, values, name=job.out.stem, image=image.name, **keys)
    rows, columns = values.shape
    console.print(
        f"{path}: {columns} x {rows} cells of {job.cell:g} m from {len(drive.ranges)} scans; "
        f"{(values == OCCUPIED).mean():.0%} occupied, {(values == FREE).mean():.0%} free",
        soft_wrap=True,
    )
    return path


def cells_of(drive: Drive, cell: float, progress: Console | None = None) -> tuple[Cells, tuple[float, float]]:
    """(rows, columns), the lowest row first, and x, y m of the lower left corner; raises UserError."""
    beams = Beams.of(drive.poses, drive.mount, drive.angles, drive.ranges)
    ends = beams.ends()
    seen = np.concatenate([ends[has_neighbours(ends)], drive.poses[:, :2]])
    corner = np.floor((seen.min(axis=0) - MARGIN) / cell) * cell
    columns, rows = (int(n) for n in np.ceil((seen.max(axis=0) + MARGIN - corner) / cell))
    if columns * rows > MAX_CELLS:
        raise UserError(f"{columns} x {rows} cells are more than {MAX_CELLS}: a larger --cell than {cell:g} m")
    ended, through = np.zeros(rows * columns, np.int64), np.zeros(rows * columns, np.int64)
    lasers = se2.compose(drive.poses, drive.mount)
    for laser, ranges in track(
        list(zip(lasers, drive.ranges, strict=True)), "mapping", console=progress, transient=True,
        disable=progress is None,
    ):  # fmt: skip
        hit, passed = (_index(points, corner, cell, rows, columns) for points in _looked(laser, ranges, drive, cell))
        ended[hit] += 1
        through[np.setdiff1d(passed, hit, assume_unique=True)] += 1
    occupied = (ended >= LEAST) & (ended >= SHARE * (ended + through))
    values = np.where(occupied, OCCUPIED, np.where(through > 0, FREE, UNKNOWN)).astype(np.uint8)
    return values.reshape(rows, columns), (float(corner[0]), float(corner[1]))


def _looked(laser: Array, ranges: Array, drive: Drive, cell: float) -> tuple[Array, Array]:
    """Points (K, 2) m in map where beams ended, and points (L, 2) all along them."""
    hit = surfaces(ranges) & (ranges < drive.range_max)
    ranges = ranges[hit]
    angles = laser[2] + drive.angles[hit]
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    along = np.arange(0.0, ranges.max(initial=0.0), cell / 2)
    beam, step = np.nonzero(along < ranges[:, None])
    return laser[:2] + ranges[:, None] * unit, laser[:2] + along[step, None] * unit[beam]


def _index(points: Array, corner: Array, cell: float, rows: int, columns: int) -> npt.NDArray[np.int64]:
    """Each cell (of rows * columns) in which points (K, 2) m lie, once."""
    column, row = np.floor((points - corner) / cell).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return np.unique(row[inside] * columns + column[inside])
