"""Gauss-Newton descent on the free energy for many poses at once.

The step is (H + P^-1 + lambda D)^-1 (xi + P^-1 (prior - x)), H the Gauss-Newton Hessian of accuracy (the Fisher
information of the density), D its diagonal. A step that does not lower F is taken back and lambda raised.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.robot.ranges import surfaces
from services.estimator.precise.likelihood import Evidence
from services.estimator.shared.asking import Conversation, alone
from services.estimator.shared.generative_models import Expect, Expected

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Likelihood
    from services.estimator.shared.generative_models import GenerativeModel

MAX_STEP = np.array([0.5, 0.5, 0.3])  # m, m, rad: beyond it the linearisation is not trusted
CONVERGED = np.array([1e-4, 1e-4, 2e-5])  # m, m, rad: a tenth of what a scan can tell
SETTLED = np.array([3e-4, 3e-4, 1e-4])  # m, m, rad: nearer, F is a parabola and the rest is algebra
WIDEST, WIDE, NARROW = 0.3, 0.1, 0.03  # m, added to every beam's deviation on the way down from a seed
DAMPING = np.diag([1.0, 1.0, 1.0]) * 1e-6  # 1/m², 1/rad²: directions of which nothing is known stay put


@dataclass(frozen=True)
class View:
    """One scan as the descent sees it."""

    model: GenerativeModel
    likelihood: Likelihood
    mount: Array  # (3,) laser in base_link
    angles: Array  # (B,) rad in laser
    ranges: Array  # (B,) m
    range_max: float  # m

    def thinned(self, beams: int) -> View:
        """Every k-th beam, so that about ``beams`` are left."""
        k = max(1, len(self.angles) // beams)
        # Contiguous: of a strided array numba would compile every loop once more.
        angles, ranges = np.ascontiguousarray(self.angles[::k]), np.ascontiguousarray(self.ranges[::k])
        return View(self.model, self.likelihood, self.mount, angles, ranges, self.range_max)

    @cached_property
    def points(self) -> Array:
        """(K, 2) m in the laser, where beams ended."""
        hit = surfaces(self.ranges) & (self.ranges < self.range_max)
        angles = self.angles[hit]
        return np.asarray(self.ranges[hit, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1))

    def evidence(self, poses: Array, widen: float = 0.0) -> Evidence:
        """What the scan says about base_link poses (N, 3), derivatives by these."""
        return alone(self.looking(poses, widen))

    def looking(self, poses: Array, widen: float = 0.0) -> Conversation[Evidence]:
        """The same; the scans expected are asked for."""
        lasers = se2.compose(poses, self.mount)
        expected: Expected = yield Expect(self.model, lasers, self.angles)
        found = self.likelihood.evaluate(self.ranges, self.range_max, expected, widen)
        # A turn of base_link moves the laser sideways: J_base = J_laser T.
        T = np.tile(np.eye(3), (len(poses), 1, 1))
        T[:, 0, 2], T[:, 1, 2] = poses[:, 1] - lasers[:, 1], lasers[:, 0] - poses[:, 0]
        Tt = T.transpose(0, 2, 1)
        return Evidence(
            found.accuracy,
            found.explained,
            (Tt @ found.xi[..., None])[..., 0],
            *(Tt @ matrix @ T for matrix in (found.curvature, found.of_noise, found.of_model)),
        )


@dataclass(frozen=True)
class Prior:
    """A Gaussian over the pose for each of N hypotheses."""

    mean: Array  # (N, 3)
    information: Array  # (N, 3, 3)

    @classmethod
    def alike(cls, count: int, mean: Array, covariance: Array) -> Prior:
        """The same (3,), (3, 3) for each of ``count``."""
        information = np.linalg.inv(covariance)
        return cls(np.tile(mean, (count, 1)), np.tile(information, (count, 1, 1)))

    def energy(self, poses: Array) -> Array:
        """(N,) nats, the quadratic part."""
        off = difference(poses, self.mean)
        return np.asarray(0.5 * np.einsum("ni,nij,nj->n", off, self.information, off))


def difference(a: Array, b: Array) -> Array:
    """(N, 3) a - b, the angle wrapped."""
    off = a - b
    off[:, 2] = se2.wrap(off[:, 2])
    return np.asarray(off)


def of_position(curvature: Array) -> Array:
    """(2, 2) what ``curvature`` (3, 3) says of the position, the heading being unknown (Schur complement)."""
    across = np.outer(curvature[:2, 2], curvature[2, :2])
    return np.asarray(curvature[:2, :2] - across / max(float(curvature[2, 2]), 1e-12))


def descend(
    view: View, poses: Array, prior: Prior | None = None, widen: float = 0.0, iterations: int = 10
) -> tuple[Array, Evidence]:
    """Poses (N, 3) after the descent from ``poses``, and the evidence there."""
    return alone(descending(view, poses, prior, widen, iterations))


def descending(
    view: View, poses: Array, prior: Prior | None = None, widen: float = 0.0, iterations: int = 10
) -> Conversation[tuple[Array, Evidence]]:
    """What `descend` does, as a conversation."""
    best = np.array(poses, float)
    evidence = yield from view.looking(best, widen)
    energy = evidence.accuracy + (prior.energy(best) if prior else 0.0)
    damping, live = np.full(len(best), 1e-3), np.ones(len(best), bool)
    for _ in range(iterations):
        step = _steps(best, evidence, prior, damping)
        live &= (np.abs(step) > CONVERGED).any(axis=1)
        if not live.any():
            break
        trial = best[live] + step[live]
        trial[:, 2] = se2.wrap(trial[:, 2])
        tried = yield from view.looking(trial, widen)
        part = Prior(prior.mean[live], prior.information[live]) if prior else None
        new = tried.accuracy + (part.energy(trial) if part else 0.0)
        better = new < energy[live]
        rows = np.flatnonzero(live)[better]
        best[rows], energy[rows] = trial[better], new[better]
        for name in ("accuracy", "explained", "xi", "curvature", "of_noise", "of_model"):
            getattr(evidence, name)[rows] = getattr(tried, name)[better]
        damping[live] = np.where(better, damping[live] * 0.1, damping[live] * 30)
        live &= damping < 1e4
    return best, evidence


def _steps(poses: Array, evidence: Evidence, prior: Prior | None, damping: Array) -> Array:
    H, slope = evidence.curvature + DAMPING, evidence.xi
    if prior:
        H = H + prior.information
        slope = slope + np.einsum("nij,nj->ni", prior.information, difference(prior.mean, poses))
    H = H + damping[:, None, None] * H * np.eye(3)
    return limited(np.linalg.solve(H, slope[..., None])[..., 0], MAX_STEP)


def limited(steps: npt.NDArray[np.floating[Any]], largest: Array) -> Array:
    """Steps (..., 3) made shorter, in their direction, so that no component exceeds ``largest`` (3,)."""
    return np.asarray(steps / np.maximum((np.abs(steps) / largest).max(axis=-1, keepdims=True), 1.0))


def polish(view: View, poses: Array, prior: Prior | None = None, iterations: int = 5) -> tuple[Array, Evidence]:
    """The last millimetres, full steps: beams that jump between surfaces ripple F there, and would stop a line search.

    Each step minimises F with the beams' weights held (iteratively reweighted least squares). Returns the last poses
    that were evaluated, at most ``SETTLED`` from the minimum, and the evidence there.
    """
    return alone(polishing(view, poses, prior, iterations))


def polishing(
    view: View, poses: Array, prior: Prior | None = None, iterations: int = 5
) -> Conversation[tuple[Array, Evidence]]:
    """What `polish` does, as a conversation."""
    poses = np.array(poses, float)
    evidence = yield from view.looking(poses)
    for _ in range(iterations - 1):
        step = _steps(poses, evidence, prior, np.zeros(len(poses)))
        if (np.abs(step) < SETTLED).all():
            break
        poses = poses + step
        poses[:, 2] = se2.wrap(poses[:, 2])
        evidence = yield from view.looking(poses)
    return poses, evidence
