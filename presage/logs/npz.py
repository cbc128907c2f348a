"""Arrays in an .npz file."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.robot.ranges import normalise_driver_ranges
from presage.logs.log import Log, LoggedScan, Reading

ARRAY_NAMES = ("ranges", "angles", "range_max", "stamps", "odom", "initial_pose", "reference")
MAX_SPAN = float(np.deg2rad(361))  # rad, from the first to the last beam
DEFAULT_MOUNT = (0.2, 0.0, 0.0)  # m, m, rad, of the shipped scanner


def open_npz(path: Path, reading: Reading) -> Log:
    """Opens an .npz file; raises UserError if an array is missing or has a wrong shape.

    The poses in the file are those of base_link; with a mount of zero they are those of the laser.
    """
    if reading.scan_topic or reading.odom_topic or reading.reference_topic:
        raise UserError(
            f"{path}: an .npz file has no topics: leave out scan_topic, odom_topic and "
            "reference_topic in section log of --config"
        )
    data, names = _load_arrays(path)
    missing = [name for name in ("ranges", "angles", "range_max") if name not in data]
    if missing:
        raise UserError(f"{path}: lacks {', '.join(missing)}; ranges (N, B), angles (B,) and range_max are required")
    ranges = np.atleast_2d(data["ranges"])
    _check_arrays(path, data, ranges)
    if data["range_max"].size != 1 or not 0 < (range_max := float(data["range_max"].reshape(-1)[0])) < np.inf:
        raise UserError(f"{path}: range_max must be one positive number, in m")
    range_max = reading.range_max or range_max
    reference = None if reading.reference is False else data.get("reference")
    notes = []
    if unknown := [name for name in names if name not in ARRAY_NAMES]:
        notes.append(f"not used: {', '.join(unknown)}; the arrays of an .npz file are {', '.join(ARRAY_NAMES)}")
    if reading.mount is None:
        notes.append(f"assumed: the laser is mounted at {DEFAULT_MOUNT[0]:g},0,0 in base_link (change with --mount)")
    return Log(
        path,
        "npz",
        data["angles"],
        np.array(DEFAULT_MOUNT) if reading.mount is None else reading.mount,
        range_max,
        len(ranges),
        lambda: _read_scans(ranges, range_max, data.get("stamps"), data.get("odom"), reference),
        odometry="odom" if "odom" in data else "",
        reference="" if reference is None else "the file's reference",
        initial_pose=data.get("initial_pose"),
        notes=notes,
        mount_assumed=reading.mount is None,
    )


def _check_arrays(path: Path, data: dict[str, Array], ranges: Array) -> None:
    count, beams = ranges.shape[0], ranges.shape[-1]
    shapes = {
        "angles": (beams,),
        "stamps": (count,),
        "odom": (count, 3),
        "initial_pose": (3,),
        "reference": (count, 3),
    }
    if ranges.ndim != 2 or beams < 3 or not count:
        raise UserError(f"{path}: ranges has the shape {data['ranges'].shape}, not (N, B) with at least 3 beams")
    for name, shape in shapes.items():
        if name in data and data[name].shape != shape:
            raise UserError(f"{path}: {name} has the shape {data[name].shape}; for these ranges it must be {shape}")
        if name in data and name not in {"odom", "reference"} and not np.isfinite(data[name]).all():
            raise UserError(f"{path}: {name} has numbers that are not finite")
    if (span := float(np.ptp(data["angles"]))) > MAX_SPAN:
        raise UserError(f"{path}: angles cover {span:.4g} rad, more than one turn: are they in degrees?")


def _read_scans(
    ranges: Array, range_max: float, stamps: Array | None, odom: Array | None, reference: Array | None
) -> Iterator[LoggedScan]:
    for k, row in enumerate(ranges):
        stamp = None if stamps is None else round(float(stamps[k]) * 1e9)
        measured = normalise_driver_ranges(row, 0.0, range_max)
        yield LoggedScan(stamp, measured, se2.known_pose(odom, k), se2.known_pose(reference, k))


def _load_arrays(path: Path) -> tuple[dict[str, Array], list[str]]:
    """Loads the arrays in `ARRAY_NAMES`, as float64. Also returns the names of all arrays."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            kept = {name: file[name] for name in file.files if name in ARRAY_NAMES}
            if wrong := [name for name, array in kept.items() if array.dtype.kind not in "fiu"]:
                raise UserError(f"{path}: {wrong[0]} holds {kept[wrong[0]].dtype}, not real numbers")
            return {name: np.asarray(array, np.float64) for name, array in kept.items()}, file.files
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (
        OSError,
        ValueError,
        zipfile.BadZipFile,
        EOFError,
        KeyError,
        NotImplementedError,
        zlib.error,
    ) as error:
        raise UserError(f"{path}: not an .npz file of plain arrays ({' '.join(str(error).split())[:120]})") from None
