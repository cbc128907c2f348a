"""The estimator of the Python API."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.errors import UserError
from common.geometry.world import World
from common.robot.ranges import normalise_driver_ranges
from common.robot.scanner import SCANNERS, Scanner
from presage.laser_scan import LaserScan
from services.estimator.factory import EstimatorOptions, EstimatorPreset, ScannerGeometry, prepare_factory
from services.estimator.paper.perception import Descent
from services.estimator.precise.gauss_newton import Optimiser
from services.estimator.precise.likelihood import Likelihood
from services.estimator.settings import ignored_settings
from services.estimator.shared.generative_models import GenerativeModel
from services.estimator.shared.interface import PoseEstimator, Posterior, Predicted

Numbers = npt.ArrayLike


class Estimator:
    """Estimates the pose of a robot in a known world from its laser scans.

    Poses are x, y in m and yaw in rad of the robot (base_link) in the world's frame (map). All scans of an estimator
    come from one scanner. One thread at a time may use an estimator.
    """

    def __init__(
        self,
        world: World | str | Path,
        preset: EstimatorPreset = "precise",
        *,
        scanner: Scanner | str | None = None,
        mount: Numbers | None = None,
        model: str | Path | GenerativeModel = "learned",
        models: Path | str | None = None,
        likelihood: Likelihood | None = None,
        optimiser: Optimiser | None = None,
        sigma: float | None = None,
        initial_pose: Numbers | None = None,
        seed: int = 0,
        descent: Descent | None = None,
    ) -> None:
        """Loads the world and the model; raises UserError if one of them does not exist or does not fit the other.

        Args:
            world: a World, or the name or file that `load_world` takes.
            preset: "precise", "paper", "particle-filter" or "amcl-defaults".
            scanner: a Scanner or its name in SCANNERS; only needed for plain arrays of ranges, and to predict before
                the first scan.
            mount: (3,) pose of the laser in base_link, m, m, rad; replaces the one that scanner or scans state. Most
                of SCANNERS state (0.2, 0, 0).
            model: for preset "precise": "learned", "exact" (rays cast in the world), a file of weights, or any object
                with the methods of GenerativeModel.
            models: folder of weights; defaults to your trained ones for the world, else the shipped ones.
            likelihood: for preset "precise": density of a range, with its own sigma; defaults to the calibrated one of
                the model. It does not decide which hypothesis is believed (docs/api.md).
            optimiser: for preset "precise": finds poses of least free energy; defaults to GaussNewton().
            sigma: for preset "precise": noise of the scanner in m, which scans then correct; defaults to what they
                state, else 0.02.
            initial_pose: (3,) pose at the first scan, or (2,) without a heading; by default, anywhere.
            seed: random seed.
            descent: parameters of preset "paper", which estimates x and y for one heading (`fixed_heading`).

        """
        if descent is not None and preset != "paper":
            raise UserError(f"descent is for preset paper only, not {preset}")
        given = [name for name, is_given in (("model", model != "learned"), ("sigma", sigma is not None)) if is_given]
        for warning in ignored_settings(preset, given):
            warnings.warn(warning, stacklevel=2)
        generative_model = None if isinstance(model, str | Path) else model
        options = EstimatorOptions(
            world if isinstance(world, World) else str(world),
            preset,
            model=str(model) if isinstance(model, str | Path) else "",
            generative_model=generative_model,
            likelihood=likelihood,
            optimiser=optimiser,
            models=None if models is None else Path(models),
            sigma=sigma,
            seed=seed,
            initial_pose=None if initial_pose is None else _start_of(initial_pose),
            descent=descent or Descent(),
        )
        self._make = prepare_factory(options)
        self._bound_to_beams = preset == "paper"
        if isinstance(scanner, str) and scanner not in SCANNERS:
            raise UserError(f"no scanner {scanner!r}: give a Scanner, or one of {', '.join(SCANNERS)}")
        self.scanner = SCANNERS[scanner] if isinstance(scanner, str) else scanner
        self._mount = None if mount is None else np.asarray(mount, float)
        if self._mount is not None and self._mount.shape != (3,):
            raise UserError(f"mount: give x, y in m and yaw in rad, not an array of shape {self._mount.shape}")
        if self._mount is not None and not np.isfinite(self._mount).all():
            raise UserError("mount: NaN and infinity are not allowed")
        self._geometry: ScannerGeometry | None = None  # of the scans
        self._core: PoseEstimator | None = None  # made for this geometry
        if self.scanner is not None:
            self._core_for(ScannerGeometry.of(self.scanner))

    @property
    def fixed_heading(self) -> float | None:
        """The one heading in rad that preset paper knows; None for the others, and until the scanner is known."""
        return getattr(self._core, "fixed_heading", None)

    def update(
        self, scan: LaserScan | Numbers, *, stamp: float | None = None, odom: Numbers | None = None
    ) -> Posterior:
        """Returns the belief after one more scan.

        ``scan`` is a LaserScan, or the ranges (B,) in m of the estimator's ``scanner``, measured at ``stamp`` (s) with
        the odometry ``odom`` (3,), base_link in odom. Odometry is used if it is given, here or in a LaserScan. Without
        stamps, scans are assumed to follow at a usual rate.
        Raises UserError if the scan does not fit the scanner or the model.
        """
        if not isinstance(scan, LaserScan):
            scan = self._scan_of(scan, stamp, odom)
        return self._core_for(scan.geometry).update(scan)

    def predict(self, poses: Numbers, angles: Numbers | None = None) -> Predicted:
        """Returns the scans that the model expects at ``poses`` (3,) or (N, 3): ranges and sigma (B,) or (N, B) in m.

        ``angles`` (B,) rad in laser defaults to the beams of the scanner. Ranges beyond the scanner's maximum are +inf.
        The belief does not change. Raises UserError if no scanner is known yet.
        """
        if self._core is None or self._geometry is None:
            raise UserError("which beams to predict is not known: give Estimator a scanner, or process a scan first")
        poses = np.asarray(poses, float)
        beams = self._geometry.angles if angles is None else np.asarray(angles, float)
        found = self._core.predict(poses.reshape(-1, 3), beams)
        shape = (*poses.shape[:-1], len(beams))
        ranges = np.where(found.ranges > self._geometry.range_max, np.inf, found.ranges)
        return Predicted(ranges.reshape(shape), found.sigma.reshape(shape))

    def restart(self, pose: Numbers | None = None, covariance: Numbers | None = None) -> None:
        """Forgets the belief; starts near ``pose`` (3,) or (2,) with ``covariance`` (3, 3), or from an unknown pose.

        Raises UserError if no scanner is known yet.
        """
        if self._core is None:
            raise UserError("nothing to restart: give Estimator a scanner, or process a scan first")
        self._core.restart(
            None if pose is None else np.asarray(pose, float),
            None if covariance is None else np.asarray(covariance, float),
        )

    def check(self, scan: LaserScan) -> None:
        """Raises UserError if the estimator cannot process the scan."""
        self._core_for(scan.geometry)

    def _scan_of(self, ranges: Numbers, stamp: float | None, odom: Numbers | None) -> LaserScan:
        scanner, measured = self.scanner, np.asarray(ranges, float)
        if scanner is None:
            raise UserError("the directions of these ranges are not known: give Estimator a scanner, or a LaserScan")
        if measured.shape != (scanner.beams,):
            raise UserError(f"ranges of shape {measured.shape}, but scanner {scanner.name} has {scanner.beams} beams")
        return LaserScan(
            normalise_driver_ranges(measured, scanner.range_min, scanner.range_max),
            scanner.angles(),
            scanner.range_max,
            stamp,
            odom,  # type: ignore[arg-type] # LaserScan converts it
            mount=scanner.mount,  # type: ignore[arg-type]
            sigma=scanner.sigma,
            sigma_relative=scanner.sigma_relative,
        )

    def _core_for(self, geometry: ScannerGeometry) -> PoseEstimator:
        """The estimator for scans of this geometry; made for that of the first scan."""
        if self._mount is not None:
            geometry = replace(geometry, mount=self._mount, mount_assumed=False)
        if self._core is None or self._geometry is None:
            self._core, self._geometry = self._make(geometry), geometry
        elif not self._geometry.same(geometry, bound_to_beams=self._bound_to_beams):
            raise UserError("the scanner, its mount or its noise has changed: make another Estimator for this scan")
        return self._core


def _start_of(pose: Numbers) -> npt.NDArray[np.float64]:
    """The initial pose as (3,) or (2,); raises UserError for another shape."""
    try:
        start = np.asarray(pose, float)
    except (TypeError, ValueError):
        raise UserError(f"initial_pose: give x, y in m and perhaps yaw in rad, not {pose!r}") from None
    if start.shape not in {(2,), (3,)} or not np.isfinite(start).all():
        raise UserError(f"initial_pose: give x, y in m and perhaps yaw in rad, not {pose!r}")
    return start
