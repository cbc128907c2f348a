"""Gauss-Newton descent on the free energy for many poses at once.

The step from pose x is (H + P^-1)^-1 (xi + P^-1 (m - x)). xi is the gradient of ln p(scan | x), H the Gauss-Newton
Hessian of -ln p (the Fisher information), m and P the mean and covariance of the prior. A small damping is added to H.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.precise.scan_likelihood import ScanLikelihood

MAX_STEP = np.array([0.5, 0.5, 0.3])  # m, m, rad: beyond this distance the linearisation is not valid
SETTLED_STEP = np.array([3e-4, 3e-4, 1e-4])  # m, m, rad: a descent ends if its next step is smaller
# Added in quadrature to every beam's standard deviation during a descent, so that the minimum is wide at first.
COARSE_SIGMA_M, MEDIUM_SIGMA_M = 0.3, 0.1
TRACKING_SCHEDULE_M = (0.05, 0.0, 0.0, 0.0, 0.0)  # at each step of a descent that starts near the minimum
MAX_POLISHING_STEPS = 4
DAMPING = 1e-6 * np.eye(3)  # 1/m², 1/rad²: no step along directions without information


class Optimiser(Protocol):
    """Minimises the free energy F of a scan: ``evidence.accuracy``, plus ``prior.energy(poses)`` with a prior."""

    def descend(
        self, scan: ScanLikelihood, poses: Array, prior: Prior | None, schedule: tuple[float, ...]
    ) -> tuple[Array, Evidence]:
        """Returns the minima of F near ``poses`` (N, 3), up to half a metre away, and the evidence there.

        ``schedule`` has a standard deviation in m for each step, which is added in quadrature to every beam's: large
        at first, so that the minimum is wide.
        """
        ...


class GaussNewton:
    """The default optimiser: expectation maximisation over the states of the beams (surface_evidence.py).

    Each step minimises F with each beam weighted by its probability of ending at the surface that the map shows.
    """

    def descend(
        self, scan: ScanLikelihood, poses: Array, prior: Prior | None, schedule: tuple[float, ...]
    ) -> tuple[Array, Evidence]:
        """See Optimiser."""
        poses = np.array(poses, float)
        for extra_sigma in schedule:
            evidence = scan.evidence(poses, extra_sigma, scan.surface_evidence(poses, extra_sigma).weights)
            step = _newton_steps(poses, evidence, prior)
            if extra_sigma == 0.0 and (np.abs(step) < SETTLED_STEP).all():
                return poses, evidence
            poses = poses + step
            poses[:, 2] = se2.wrap(poses[:, 2])
        return poses, scan.evidence(poses, 0.0, scan.surface_evidence(poses).weights)


@dataclass(frozen=True)
class Prior:
    """A Gaussian over the pose for each of N hypotheses."""

    mean: Array  # (N, 3)
    information: Array  # (N, 3, 3)

    @classmethod
    def repeated(cls, count: int, mean: Array, covariance: Array) -> Prior:
        """The same Gaussian (3,), (3, 3) for each of ``count`` hypotheses."""
        information = np.linalg.inv(covariance)
        return cls(np.tile(mean, (count, 1)), np.tile(information, (count, 1, 1)))

    def at(self, row: int) -> Prior:
        """Returns the prior of one hypothesis."""
        return Prior(self.mean[row : row + 1], self.information[row : row + 1])

    def energy(self, poses: Array) -> Array:
        """Negative log density (N,) of poses (N, 3) in nats, without its constant."""
        offset = se2.difference(poses, self.mean)
        return np.asarray(0.5 * np.einsum("ni,nij,nj->n", offset, self.information, offset))


def position_information(curvature: Array) -> Array:
    """Information (2, 2) about the position in ``curvature`` (3, 3), with the heading unknown (Schur complement)."""
    across = np.outer(curvature[:2, 2], curvature[2, :2])
    return np.asarray(curvature[:2, :2] - across / max(float(curvature[2, 2]), 1e-12))


def _newton_steps(poses: Array, evidence: Evidence, prior: Prior | None) -> Array:
    H, slope = evidence.curvature + DAMPING, evidence.xi
    if prior:
        H = H + prior.information
        slope = slope + np.einsum("nij,nj->ni", prior.information, se2.difference(prior.mean, poses))
    return limit_steps(np.linalg.solve(H, slope[..., None])[..., 0], MAX_STEP)


def limit_steps(steps: npt.NDArray[np.floating[Any]], largest: Array) -> Array:
    """Shortens steps (..., 3) without changing their direction, so that no component exceeds ``largest`` (3,)."""
    return np.asarray(steps / np.maximum((np.abs(steps) / largest).max(axis=-1, keepdims=True), 1.0))


def polish(scan: ScanLikelihood, poses: Array) -> tuple[Array, Evidence]:
    """Finds the minimum of -ln p(scan | pose) to a fraction of a millimetre, from poses (N, 3) already near it.

    Takes at most `MAX_POLISHING_STEPS` Gauss-Newton steps, without a prior and without evidence by surfaces, until the
    next one would be less than `SETTLED_STEP`. Returns the last poses that were evaluated, and the evidence there.
    """
    poses = np.array(poses, float)
    evidence = scan.evidence(poses)
    for _ in range(MAX_POLISHING_STEPS):
        step = _newton_steps(poses, evidence, None)
        if (np.abs(step) < SETTLED_STEP).all():
            break
        poses = poses + step
        poses[:, 2] = se2.wrap(poses[:, 2])
        evidence = scan.evidence(poses)
    return poses, evidence
