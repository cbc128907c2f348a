"""`presage localize`: runs an estimator over a recording or log."""

from __future__ import annotations

import csv
import json
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TextIO, get_args

import numpy as np
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.geometry.pose_text import parse_initial_pose
from common.geometry.se2 import Array
from common.geometry.tum import write_tum
from common.geometry.world import load_world
from common.writing import complete_files, name_in_errors
from presage.estimator import Estimator
from presage.interrupts import ignoring_interrupts
from presage.laser_scan import LaserScan
from presage.logs.log import Reading
from presage.logs.opening import kind_of
from presage.logs.scan_files import Prior, Scans, read_scans
from presage.terminal.output import check_file, provenance
from presage.terminal.progress import progress, working
from services.estimator.factory import EstimatorOptions, EstimatorPreset, check_start
from services.estimator.paper.perception import Descent
from services.estimator.shared.interface import Posterior
from services.recorder.reader import read_recording
from services.recorder.replaying.player import span

COLUMNS = (
    "stamp",
    "x",
    "y",
    "yaw",
    "cov_xx",
    "cov_xy",
    "cov_xyaw",
    "cov_yy",
    "cov_yyaw",
    "cov_yawyaw",
    "free_energy",
    "state",
    "probability",
    "update_ms",
)
HEADING_TOLERANCE_RAD = np.deg2rad(2.0)  # between the robot's heading and the one of preset paper
STAMP_ROUNDING_S = 1e-6  # precision of a double for a stamp of the year 2020
UPPER_TRIANGLE = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]


@dataclass(frozen=True)
class LocalizeOptions:
    """Options of `presage localize`."""

    file: Path
    estimator_options: EstimatorOptions
    mode: Literal["global", "track", "single"] = "global"  # single: each scan as if it were the first
    prior: Prior = "odometry"
    frame: Literal["base_link", "laser"] = "base_link"
    reading: Reading = Reading()  # noqa: RUF009 - frozen
    out: Path | None = None  # CSV, JSON or TUM; defaults to CSV on standard output
    start: float | None = None  # s after the first scan; defaults to the first scan
    end: float | None = None  # s after the first scan, or if negative, from the last; defaults to the last scan
    every: int = 1  # use every N-th scan between these

    @classmethod
    def of(
        cls,
        file: Path,
        estimator_options: EstimatorOptions,
        mode: str,
        frame: str,
        reading: Reading,
        *,
        odometry: bool,
        out: Path | None,
        start: float | None = None,
        end: float | None = None,
        every: int = 1,
    ) -> LocalizeOptions:
        """Checks the options of the command line; raises UserError if a value is unknown."""
        if mode not in ("global", "track", "single"):
            raise UserError(f"no mode {mode!r}: choose global, track or single")
        if frame not in ("base_link", "laser"):
            raise UserError(f"no frame {frame!r}: choose base_link or laser")
        if out is not None and out.suffix not in (".csv", ".json", ".tum"):
            raise UserError(f"{out}: the name of the result must end with .csv, .json or .tum")
        prior: Prior = "odometry" if odometry else "motion"
        return cls(file, estimator_options, mode, prior, frame, reading, out, start, end, every)  # type: ignore[arg-type]


def build_estimator_options(
    file: Path,
    world: str,
    estimator: str,
    model: str,
    models: Path | None,
    sigma: float | None,
    seed: int,
    initial_pose: str,
    descent: Descent = Descent(),
) -> EstimatorOptions:
    """The estimator chosen on the command line; the world defaults to that of the recording.

    Raises UserError if the estimator is unknown or there is no world.
    """
    if estimator not in get_args(EstimatorPreset):
        raise UserError(f"no estimator {estimator!r}: choose one of {', '.join(get_args(EstimatorPreset))}")
    pose = parse_initial_pose(initial_pose, "--initial-pose") if initial_pose else None
    if not world:
        if kind_of(file) != "recording":
            raise UserError(f"{file}: a log does not state its world: give it with --world")
        recorded = read_recording(file).world()
        if recorded is None:
            raise UserError(f"{file}: no world was recorded: give one with --world")
        return EstimatorOptions(recorded, estimator, model, models, sigma, seed, pose, descent)  # type: ignore[arg-type]
    return EstimatorOptions(world, estimator, model, models, sigma, seed, pose, descent)  # type: ignore[arg-type]


@dataclass(frozen=True)
class TimedBelief:
    """A belief, and how long it took."""

    posterior: Posterior
    update_ms: float


def run_estimator(
    estimator: Estimator, scans: Iterable[LaserScan], *, independent_scans: bool = False, start: Array | None = None
) -> Iterator[TimedBelief]:
    """Yields the belief after each scan, from ``start`` (3,) or (2,), or from an unknown pose.

    With ``independent_scans``, every later scan starts from it again. Call `check_scans` before.
    """
    for k, scan in enumerate(scans):
        must_restart = independent_scans if k > 0 else start is not None
        if must_restart:
            estimator.restart(start)
        began = time.perf_counter()
        posterior = estimator.update(scan)
        yield TimedBelief(posterior, (time.perf_counter() - began) * 1e3)


def prepare_estimator(estimator_options: EstimatorOptions, console: Console) -> Estimator:
    """The chosen estimator, without its initial pose."""
    with working(f"preparing {estimator_options.estimator} for {estimator_options.world_argument}", console):
        preset = estimator_options.estimator
        return Estimator(
            estimator_options.world,
            preset,
            model=estimator_options.model if preset == "precise" else "learned",
            models=estimator_options.models,
            sigma=estimator_options.sigma if preset == "precise" else None,
            seed=estimator_options.seed,
            descent=estimator_options.descent if preset == "paper" else None,
        )


def check_scans(estimator: Estimator, scans: Scans, console: Console) -> None:
    """Raises UserError if the estimator cannot process the scans, and warns if their poses will be wrong."""
    estimator.check(scans[0])
    if warning := _heading_warning(estimator, scans):
        console.print(warning, highlight=False, soft_wrap=True)


def _heading_warning(estimator: Estimator, scans: Scans) -> str:
    """A warning if the robot has another heading than the one that the estimator assumes; "" if it has not.

    Uses the truth; without it the odometry, with a first heading that is assumed to be right.
    """
    heading = estimator.fixed_heading
    if heading is None:
        return ""
    source, headings = scans.truth_is, np.zeros(0)
    if scans.truth is not None:
        headings = scans.truth[np.isfinite(scans.truth[:, 2]), 2]
    if not len(headings) and scans.odom is not None:
        source, headings = "the odometry", scans.odom[np.isfinite(scans.odom[:, 2]), 2]
        headings = headings - headings[:1] + heading
    others = int((np.abs(se2.wrap(headings - heading)) > HEADING_TOLERANCE_RAD).sum())
    if not others:
        return ""
    return (
        f"warning: preset paper assumes a heading of {np.rad2deg(heading):.0f} deg, but according to {source} the "
        f"robot has another in {others} of {len(headings)} scans: their poses will be wrong"
    )


def localize(options: LocalizeOptions, console: Console) -> list[dict[str, Any]]:
    """Localises each scan; writes the rows as they are computed, prints a summary and returns the rows.

    After Ctrl-C, prints the summary of the scans so far and raises KeyboardInterrupt.
    """
    check_file(options.out, "--out")
    if options.estimator_options.initial_pose is not None:
        if options.mode != "track":
            raise UserError("--initial-pose is for mode track only: add --mode track, or leave it out")
        world = options.estimator_options.world
        check_start(options.estimator_options.initial_pose, load_world(world) if isinstance(world, str) else world)
    laser, kind = options.frame == "laser", kind_of(options.file)
    estimator = prepare_estimator(options.estimator_options, console)
    with working(f"reading {options.file.name}", console):
        # With frame laser, the poses in an .npz file are those of the laser, as if its mount were zero. For other
        # files, base_link is localised and the result transformed.
        mount = np.zeros(3) if laser and kind == "npz" else None
        all_scans = read_scans(options.file, mount, options.reading)
    all_scans.print_notes(console)
    selected = select_scans(options, all_scans)
    scans = selected.with_prior(options.prior)
    if scans.stamps is None and options.out is not None and options.out.suffix == ".tum":
        raise UserError(f"{options.file}: its scans have no stamps, which a trajectory needs: choose .csv or .json")
    start, count = _start(options, scans), len(scans)
    check_scans(estimator, selected, console)
    rows: list[dict[str, Any]] = []
    try:
        found = run_estimator(estimator, scans, independent_scans=options.mode == "single", start=start)
        with _output(options, count) as write, closing(_with_progress(options, found, count, console)) as localised:
            for k, timed in enumerate(localised):
                row = _row(scans, k, timed, laser=laser)
                write(row)
                rows.append(row)
    except KeyboardInterrupt:
        with ignoring_interrupts():
            _summarise(scans, rows, len(all_scans), console, laser=laser)
            where = "" if options.out is None else f"; their rows are in {options.out}"
            console.print(f"interrupted after {len(rows)} of {count} scans{where}", highlight=False, soft_wrap=True)
        raise
    _summarise(scans, rows, len(all_scans), console, laser=laser)
    if options.mode != "single" and all(row["state"] != "tracking" for row in rows):
        console.print("the pose was never certain enough for state tracking: is this the right map?")
    return rows


def select_scans(options: LocalizeOptions, scans: Scans) -> Scans:
    """The scans selected by --start, --end and --every; raises UserError if there are none."""
    if options.start is None and options.end is None and options.every == 1:
        return scans
    # Without stamps, an estimator assumes that each scan follows the one before at a usual rate.
    if scans.stamps is None:
        raise UserError(f"{options.file}: its scans have no stamps, which --start, --end and --every need")
    since = scans.stamps - scans.stamps[0]
    first, last = span(float(since[-1]), options.start, options.end)
    between = (since >= first - STAMP_ROUNDING_S) & (since <= last + STAMP_ROUNDING_S)
    if not between.any():
        raise UserError(f"{options.file}: no scan between {first:g} and {last:g} s (--start, --end)")
    return scans.part(np.flatnonzero(between)[:: options.every])


def _with_progress(
    options: LocalizeOptions, found: Iterator[TimedBelief], count: int, console: Console
) -> Generator[TimedBelief]:
    """Shows the progress, unless the rows themselves are printed to the same terminal."""
    if options.out is None and sys.stdout.isatty() and console.is_terminal:
        yield from found
        return
    yield from progress(found, "localising", count, console)


def _start(options: LocalizeOptions, scans: Scans) -> Array | None:
    """The start of mode track, (3,) or (2,): given, or from the file or its reference. None for other modes."""
    if options.mode != "track":
        return None
    if options.estimator_options.initial_pose is not None:
        return options.estimator_options.initial_pose
    if scans.initial_pose is not None:
        return scans.initial_pose
    if scans.truth is not None and np.isfinite(scans.truth[0]).all():
        return np.asarray(scans.truth[0])
    raise UserError(
        f"{options.file}: mode track needs the pose of the first scan: give --initial-pose x,y,deg, or a file with a "
        "reference (its initial_pose is used only without --start)"
    )


def _row(scans: Scans, k: int, timed: TimedBelief, *, laser: bool) -> dict[str, Any]:
    posterior = timed.posterior
    pose, covariance = posterior.pose, posterior.covariance
    mount = scans.geometry.mount
    if laser and mount.any():  # the estimator localises base_link
        jacobian, _ = se2.compose_jacobians(pose, mount)
        pose = se2.compose(pose, mount)
        covariance = None if covariance is None else jacobian @ covariance @ jacobian.T
    values = [None if covariance is None else float(covariance[i, j]) for i, j in UPPER_TRIANGLE]
    stamp = None if scans.stamps is None else float(scans.stamps[k])
    belief = [posterior.free_energy, posterior.state, posterior.probability]
    numbers = [stamp, *map(float, pose), *values, *belief, round(timed.update_ms, 3)]
    return dict(zip(COLUMNS, numbers, strict=True))


@contextmanager
def _output(options: LocalizeOptions, count: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yields the function that writes a row: at once for CSV; else at the end, also after an interruption."""
    if options.out is not None and options.out.suffix != ".csv":
        rows: list[dict[str, Any]] = []
        try:
            yield rows.append
        finally:
            with ignoring_interrupts(), complete_files(options.out) as partial:
                out = partial / options.out.name
                if out.suffix == ".json":
                    _write_json(options, out, rows, complete=len(rows) == count)
                else:
                    poses = np.array([[row["x"], row["y"], row["yaw"]] for row in rows]).reshape(-1, 3)
                    write_tum(out, np.array([row["stamp"] for row in rows]), poses, options.frame)
        return
    with nullcontext(sys.stdout) if options.out is None else _closing_named(options.out) as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        writer.writeheader()

        def write(row: dict[str, Any]) -> None:
            with nullcontext() if options.out is None else name_in_errors(options.out):
                writer.writerow(row)
                stream.flush()  # so that the rows so far are in the file however the run ends

        yield write


@contextmanager
def _closing_named(out: Path) -> Iterator[TextIO]:
    """Opens a new file; an error while it is closed, when the last rows are written, names it."""
    stream = out.open("w", newline="", encoding="utf-8")
    try:
        yield stream
    finally:
        with name_in_errors(out):
            stream.close()


def _write_json(options: LocalizeOptions, out: Path, rows: list[dict[str, Any]], *, complete: bool) -> None:
    meta = {
        "file": str(options.file),
        "world": options.estimator_options.world_argument,
        "estimator": options.estimator_options.estimator,
        "model": options.estimator_options.model,
        "frame": options.frame,
        "mode": options.mode,
        "start": options.start,
        "end": options.end,
        "every": options.every,
        "complete": complete,
        **provenance(options.estimator_options.seed),
    }
    out.write_text(json.dumps({**meta, "rows": rows}, indent=1) + "\n", encoding="utf-8")


def _summarise(scans: Scans, rows: list[dict[str, Any]], in_file: int, console: Console, *, laser: bool) -> None:
    """Prints states, computing time and errors of the rows; nothing if there are no rows."""
    if not rows:
        return
    states: dict[str, int] = {}
    for row in rows:
        states[row["state"]] = states.get(row["state"], 0) + 1
    scans_done = f"{len(rows)} scans" if len(rows) == in_file else f"{len(rows)} of {in_file} scans"
    counts = ", ".join(f"{count} {state}" for state, count in states.items())
    update_ms = np.median([row["update_ms"] for row in rows])
    console.print(f"{scans_done}: {counts}; update {update_ms:.2f} ms median")
    if scans.truth is None:
        return
    truth = scans.truth[: len(rows)]
    truth = se2.compose(truth, scans.geometry.mount) if laser else truth
    poses = np.array([[row["x"], row["y"], row["yaw"]] for row in rows])
    tracking = np.array([row["state"] == "tracking" for row in rows])
    used = np.isfinite(truth).all(axis=1) & (tracking if tracking.any() else True)
    poses, truth = poses[used], truth[used]
    if not len(poses):
        return
    which = "tracking scans" if tracking.any() else "all scans"
    console.print(f"{which} against {scans.truth_is}: {_errors(poses, truth)}")
    frame = se2.alignment(truth, poses)
    if len(poses) > 1:
        console.print(
            f"with the reference moved by {frame[0]:.3f}, {frame[1]:.3f} m and {np.rad2deg(frame[2]):.2f} deg to fit: "
            f"{_errors(poses, se2.compose(frame, truth))}"
        )


def _errors(poses: Array, truth: Array) -> str:
    error = np.hypot(*(poses - truth)[:, :2].T) * 1e3
    return f"{np.median(error):.1f} mm median, {np.sqrt(np.mean(error**2)):.1f} mm RMS, {error.max():.1f} mm maximum"
