"""The likelihood of one scan for poses, by beams and by surfaces, with all that it depends on."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.errors import UserError
from common.geometry import se2
from common.robot.ranges import is_surface
from services.estimator.precise.gauss_newton import TRACKING_SCHEDULE_M, GaussNewton, Optimiser, Prior
from services.estimator.precise.likelihood import Evidence
from services.estimator.precise.scan_surfaces import EDGE_M, ScanSurfaces
from services.estimator.precise.surface_evidence import SurfaceEvidence, find_borders

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Likelihood
    from services.estimator.shared.generative_models import Expected, GenerativeModel

# The errors of a map are counted as equal over this length of a surface, and as independent beyond (a guess).
CORRELATION_LENGTH_M = 2.0


@dataclass(frozen=True)
class _PredictedScans:
    """What the model predicts at some poses, and the evidence that was computed from it."""

    poses: Array  # (N, 3)
    expected: Expected  # with the error that the model states
    with_map_error: Expected  # with the learned error of the map as well
    behind: Array  # (N, B) m, to the map's next surface where the scan passes through the first, else inf
    borders: npt.NDArray[np.bool_]  # (N, B) see find_borders
    evidence: dict[float, SurfaceEvidence] = field(default_factory=dict)  # by ``extra_sigma``

    def first(self, count: int) -> _PredictedScans:
        """The same at the first ``count`` poses."""
        rows = slice(count)
        expected, with_map_error = self.expected.part(rows), self.with_map_error.part(rows)
        evidence = {extra_sigma: each.first(count) for extra_sigma, each in self.evidence.items()}
        return _PredictedScans(
            self.poses[rows], expected, with_map_error, self.behind[rows], self.borders[rows], evidence
        )


@dataclass(frozen=True)
class ScanLikelihood:
    """One scan, with all that its evidence for a pose depends on: the model, its errors and the density of a beam."""

    model: GenerativeModel
    likelihood: Likelihood
    mount: Array  # (3,) laser in base_link
    angles: Array  # (B,) rad in laser
    ranges: Array  # (B,) m
    range_max: float  # m
    optimiser: Optimiser = field(default_factory=GaussNewton)
    map_error: float = 0.0  # m, standard deviation of the map's error beyond what the model states
    correlated_fraction: float = 0.0  # of the variance of the map's error: alike for beams on the same segment
    changed_fraction: float = 0.25  # fraction of the beams that do not end at the map's first surface
    map_cell: float = 0.0  # m, edge of the cells if the map is a grid
    map_offset: float = 0.0  # m, mean distance of the real surfaces behind those that the model predicts
    log_map_error_prior: float = 0.0  # nats, log probability that the map's error is this large
    # (B,) s after the middle of the sweep, 0 if all beams were measured at once; (1,) if they are not corrected
    times: Array = field(default_factory=lambda: np.zeros(1))
    _last: deque[_PredictedScans] = field(default_factory=lambda: deque(maxlen=2), init=False, repr=False)

    def thinned(self, beams: int) -> ScanLikelihood:
        """Returns the likelihood of every k-th beam, so that ``beams`` (or all) or up to twice as many are left."""
        k = max(1, len(self.angles) // beams)
        # numba would compile every loop once more for strided arrays, so these are contiguous.
        angles, ranges = np.ascontiguousarray(self.angles[::k]), np.ascontiguousarray(self.ranges[::k])
        return replace(self, angles=angles, ranges=ranges, times=self.times[::k])

    def descend(
        self, poses: Array, prior: Prior | None = None, schedule: tuple[float, ...] = TRACKING_SCHEDULE_M
    ) -> tuple[Array, Evidence]:
        """Returns the minima near ``poses`` (N, 3), and the evidence there (see Optimiser)."""
        found = self.optimiser.descend(self, poses, prior, schedule)
        if not (isinstance(found, tuple) and np.shape(found[0]) == poses.shape and isinstance(found[-1], Evidence)):
            raise UserError(
                f"optimiser: {type(self.optimiser).__name__}.descend must return a tuple: poses of the shape given, "
                f"{poses.shape}, and the Evidence there"
            )
        return found

    @cached_property
    def returned(self) -> npt.NDArray[np.bool_]:
        """Mask (B,) of the beams that returned from a surface."""
        return np.asarray(is_surface(self.ranges) & (self.ranges < self.range_max))

    @cached_property
    def points(self) -> Array:
        """End points (K, 2) of the beams that returned, m in the laser frame."""
        angles = self.angles[self.returned]
        return np.asarray(self.ranges[self.returned, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1))

    @cached_property
    def sorted_beams(self) -> tuple[npt.NDArray[np.intp], Array]:
        """The beams (B,) in the order of their angles, and the sorted angles (B,) in rad.

        The beams of a scan that was corrected for motion are not evenly spaced, and a few have changed places.
        """
        order = np.argsort(self.angles, kind="stable")
        return order, self.angles[order]

    @cached_property
    def spacing(self) -> float:
        """Angle in rad between neighbouring beams."""
        return float(np.median(np.diff(self.sorted_beams[1])))

    @cached_property
    def nearest_of_neighbours(self) -> Array:
        """The smallest (B,) of the ranges of each beam and its two neighbours; the first and last have one."""
        count = len(self.ranges)
        around = np.stack([self.ranges[np.clip(np.arange(count) + k, 0, count - 1)] for k in (-1, 0, 1)])
        return np.asarray(np.where(np.isnan(around), -np.inf, around).min(axis=0))

    @cached_property
    def surfaces(self) -> ScanSurfaces:
        """The surfaces that the scan shows."""
        return ScanSurfaces.from_scan(self.ranges, self.angles, self.likelihood, max(EDGE_M, self.map_cell))

    def expect(self, lasers: Array) -> Expected:
        """The scans that the model predicts at laser poses (N, 3), with its surfaces moved back by the map's offset."""
        return self.model.expect(lasers, self.angles).moved_back(self.map_offset)

    def _with_map_error(self, expected: Expected) -> Expected:
        """Adds the map's error, which is perpendicular to a surface and so larger along beams that graze it."""
        if not self.map_error:
            return expected
        return replace(expected, scale=np.hypot(expected.scale, self.map_error * expected.slope))

    @cached_property
    def _correlation(self) -> float:
        """Factor on the covariance of the model's error, because part of it is alike along a surface."""
        if len(self.points) < 2:
            return 1.0
        spacing = float(np.median(np.hypot(*np.diff(self.points, axis=0).T)))
        beams = max(1.0, CORRELATION_LENGTH_M / max(spacing, 1e-3))  # on one correlation length
        return 1 + self.correlated_fraction * (beams - 1)

    def surface_evidence(self, poses: Array, extra_sigma: float = 0.0) -> SurfaceEvidence:
        """Returns the evidence by surfaces at base_link poses (N, 3)."""
        at = self._predicted(poses)
        if extra_sigma not in at.evidence:
            at.evidence[extra_sigma] = SurfaceEvidence.from_scan(
                self.ranges,
                self.range_max,
                at.with_map_error,
                at.behind,
                at.borders,
                self.surfaces,
                self.likelihood,
                self.changed_fraction,
                extra_sigma,
            )
        return at.evidence[extra_sigma]

    def count_surfaces(self, beams: npt.NDArray[np.bool_]) -> int:
        """Number of surfaces of which most measured beams are among ``beams`` (B,)."""
        surface, measured = np.cumsum(self.surfaces.starts), self.ranges > -np.inf  # not NaN either
        return int((np.bincount(surface, beams) > 0.5 * np.bincount(surface, measured)).sum())

    def expected(self, pose: Array) -> Expected:
        """The scan that the model predicts at one ``pose`` (3,)."""
        return self._predicted(pose[None]).expected

    def _predicted(self, poses: Array) -> _PredictedScans:
        """The scans predicted at poses (N, 3).

        Caches the last two results, because several kinds of evidence are computed at the same poses, or at the first
        few.
        """
        for at in self._last:
            if np.array_equal(at.poses[: len(poses)], poses):
                if len(poses) < len(at.poses):
                    self._last.appendleft(at.first(len(poses)))
                    return self._last[0]
                return at
        lasers = se2.compose(poses, self.mount)
        expected = self.expect(lasers)
        with_map_error = self._with_map_error(expected)
        with np.errstate(invalid="ignore"):
            passed = self.ranges > expected.ranges + self.likelihood.deviation(expected.ranges)
        behind = self.model.expect_behind(lasers, self.angles, np.where(passed, expected.ranges, np.inf))
        borders = find_borders(expected, lasers, self.angles)
        self._last.appendleft(_PredictedScans(np.array(poses), expected, with_map_error, behind, borders))
        return self._last[0]

    def evidence(self, poses: Array, extra_sigma: float = 0.0, weights: Array | None = None) -> Evidence:
        """Returns the evidence of the scan at base_link poses (N, 3), with derivatives by these poses.

        ``extra_sigma`` m is added in quadrature to every beam's standard deviation. ``weights`` (N, B) scale the
        derivatives of each beam.
        """
        lasers = se2.compose(poses, self.mount)
        if weights is None:
            expected = self._with_map_error(self.expect(lasers))
        else:
            expected = self._predicted(poses).with_map_error
        at_laser = self.likelihood.evaluate(self.ranges, self.range_max, expected, extra_sigma, weights)
        return self._at_base(at_laser, poses, lasers)

    def evidence_of_each_surface(self, pose: Array) -> Evidence:
        """Returns the evidence at ``pose`` (3,) from each surface of the scan alone, for the N that the map shows."""
        expected, surface = self._predicted(pose[None]).with_map_error, np.cumsum(self.surfaces.starts)
        weights = self.surface_evidence(pose[None]).weights * ~self.surfaces.small
        shown = np.unique(surface[weights[0] > 0])
        first, last = np.searchsorted(surface, shown), np.searchsorted(surface, shown, "right")
        parts = [
            self.likelihood.evaluate(self.ranges[a:b], self.range_max, expected.beams(a, b), 0.0, weights[:, a:b])
            for a, b in zip(first, last, strict=True)
        ]
        at_laser = Evidence.joined(parts) if parts else self.evidence(pose[None]).part(np.arange(0))
        poses = np.tile(pose, (len(shown), 1))
        return self._at_base(at_laser, poses, se2.compose(poses, self.mount))

    def _at_base(self, at_laser: Evidence, poses: Array, lasers: Array) -> Evidence:
        """The evidence with derivatives by base_link poses (N, 3) instead of by those of the laser, ``lasers``."""
        # A rotation of base_link moves the laser sideways: J_base = J_laser T.
        T = np.tile(np.eye(3), (len(poses), 1, 1))
        T[:, 0, 2], T[:, 1, 2] = poses[:, 1] - lasers[:, 1], lasers[:, 0] - poses[:, 0]
        Tt = T.transpose(0, 2, 1)
        model_covariance = at_laser.xi_model_covariance * self._correlation
        matrices = (at_laser.curvature, at_laser.xi_noise_covariance, model_covariance)
        return Evidence(
            at_laser.accuracy,
            (Tt @ at_laser.xi[..., None])[..., 0],
            *(Tt @ matrix @ T for matrix in matrices),
        )
