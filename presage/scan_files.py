"""Scans in a file, for `presage localize`: .npz, or a recording."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.errors import UserError
from common.messages import Odom, Scan, Truth
from common.se2 import Array
from common.topics import ODOM, SCAN, TRUTH
from services.estimator.building import Geometry
from services.estimator.interface import Observation
from services.recorder.reader import read_recording

NAMES = {"ranges", "angles", "range_max", "stamps", "odom", "initial_pose"}


@dataclass(frozen=True)
class Scans:
    """N scans of B beams."""

    geometry: Geometry
    ranges: Array  # (N, B) m; +inf no return, -inf too close
    stamps: Array | None = None  # (N,) s
    odom: Array | None = None  # (N, 3) base_link in odom
    initial_pose: Array | None = None  # (3,) in map
    truth: Array | None = None  # (N, 3) base_link in map; NaN where not recorded
    world: str | None = None  # name of the world it was recorded in

    def observation(self, k: int, *, odometry: bool = True) -> Observation:
        """The k-th scan for an estimator."""
        odom = self.odom[k] if odometry and self.odom is not None and np.isfinite(self.odom[k]).all() else None
        stamp = None if self.stamps is None else float(self.stamps[k])
        return Observation(self.ranges[k], self.geometry.angles, self.geometry.range_max, stamp, odom)


def read_scans(path: Path, mount: Array) -> Scans:
    """Of an .npz (``mount`` (3,): its laser in base_link) or a recording; raises UserError saying what is wrong."""
    if path.suffix == ".npz":
        return _read_npz(path, mount)
    if path.suffix in {".mcap", ".active"}:
        return _read_recording(path)
    raise UserError(f"{path}: scans are read from .npz (ranges, angles, range_max) or .mcap (a recording)")


def _read_npz(path: Path, mount: Array) -> Scans:
    data = _arrays(path)
    missing = [name for name in ("ranges", "angles", "range_max") if name not in data]
    if missing:
        raise UserError(f"{path}: lacks {', '.join(missing)}; needed are ranges (N, B), angles (B,) and range_max")
    ranges = np.atleast_2d(data["ranges"])
    count, beams = ranges.shape[0], ranges.shape[-1]
    shapes = {"angles": (beams,), "stamps": (count,), "odom": (count, 3), "initial_pose": (3,)}
    if ranges.ndim != 2 or beams < 3 or not count:
        raise UserError(f"{path}: ranges has the shape {data['ranges'].shape}, not (N, B) of 3 beams or more")
    for name, shape in shapes.items():
        if name in data and data[name].shape != shape:
            raise UserError(f"{path}: {name} has the shape {data[name].shape}; for these ranges it must be {shape}")
        if name in data and not np.isfinite(data[name]).all():
            raise UserError(f"{path}: {name} has numbers that are not finite")
    if data["range_max"].size != 1 or not 0 < (range_max := float(data["range_max"].reshape(-1)[0])) < np.inf:
        raise UserError(f"{path}: range_max must be one number of metres greater than 0")
    if "stamps" in data and (np.diff(data["stamps"]) < 0).any():
        raise UserError(f"{path}: stamps are not sorted")
    return Scans(
        Geometry(data["angles"], mount, range_max), clean(ranges, range_max),
        data.get("stamps"), data.get("odom"), data.get("initial_pose"),
    )  # fmt: skip


def _arrays(path: Path) -> dict[str, Array]:
    """The arrays we know, as numbers."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            kept = {name: file[name] for name in file.files if name in NAMES}
            if wrong := [name for name, array in kept.items() if array.dtype.kind not in "fiu"]:
                raise UserError(f"{path}: {wrong[0]} holds {kept[wrong[0]].dtype}, not real numbers")
            data = {name: np.asarray(array, np.float64) for name, array in kept.items()}
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (OSError, ValueError, zipfile.BadZipFile, EOFError, KeyError) as error:
        raise UserError(f"{path}: not an .npz of plain arrays ({' '.join(str(error).split())[:120]})") from None
    return data


def clean(ranges: Array, range_max: float) -> Array:
    """As REP-117 has it: at or beyond the longest range +inf; NaN and what is not positive -inf (not used)."""
    far = np.where(ranges >= range_max, np.inf, ranges)
    return np.where(np.isnan(far) | (far <= 0), -np.inf, far)


def _read_recording(path: Path) -> Scans:
    recording = read_recording(path)
    scans: list[Scan] = []
    odoms: dict[int, Array] = {}
    truths: dict[int, Array] = {}
    for _, message, _ in recording.messages(SCAN, ODOM, TRUTH):
        if isinstance(message, Scan) and (not scans or message.stamp_ns > scans[-1].stamp_ns):
            scans.append(message)
        elif isinstance(message, Odom):
            odoms[message.stamp_ns] = message.pose.array()
        elif isinstance(message, Truth):
            truths[message.stamp_ns] = message.pose.array()
    if recording.warning:  # damage is found on the way
        print(recording.warning)
    if not scans:
        raise UserError(f"{path}: no scan in it")
    first = scans[0]
    alike = [s for s in scans if len(s.ranges) == len(first.ranges) and s.mount == first.mount]
    if len(alike) != len(scans):
        raise UserError(f"{path}: the scanner changes on the way; localize takes one scanner a file")
    nothing = np.full(3, np.nan)
    world = recording.world()
    return Scans(
        Geometry.of_scan(first),
        np.array([s.ranges for s in scans], np.float64),
        np.array([s.stamp_ns for s in scans]) * 1e-9,
        np.array([odoms.get(s.stamp_ns, nothing) for s in scans]) if odoms else None,
        None,
        np.array([truths.get(s.stamp_ns, nothing) for s in scans]) if truths else None,
        world.name if world is not None else None,
    )
