"""The Cramér-Rao bound (Censi 2007)."""

from __future__ import annotations

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from lab.accuracy.scenes import Scene
from services.estimator.shared.generative_models import RayCaster
from services.simulator.odometry import OdometryNoise

# 1/m², added to the information: a direction that a scan does not constrain gets a very large but finite bound.
REGULARISATION = 1e-9


def information(scene: Scene, poses: Array) -> Array:
    """(N, 3, 3) Fisher information that one scan holds about the pose of base_link, at each of ``poses`` (N, 3).

    It is the sum of J'J / sigma² over beams, with J from exact rays. Beams beyond the scanner's maximum range are left
    out. Where sigma grows with the range, the information in sigma itself is left out too.
    """
    mount = np.array(scene.scanner.mount)
    lasers = se2.compose(poses, mount)
    expected = RayCaster(scene.world).expect(lasers, scene.scanner.angles())
    seen = (expected.ranges >= scene.scanner.range_min) & (expected.ranges <= scene.scanner.range_max)
    J = np.where(seen[..., None], expected.jacobian, 0)
    J[..., 2] += J[..., 0] * (poses[:, 1] - lasers[:, 1])[:, None] + J[..., 1] * (lasers[:, 0] - poses[:, 0])[:, None]
    weighted = J / scene.scanner.deviation(np.where(seen, expected.ranges, 0.0))[..., None] ** 2
    return np.asarray(np.einsum("nbi,nbj->nij", weighted, J) + REGULARISATION * np.eye(3))


def position(covariance: Array) -> Array:
    """Root mean square position error (N,), m, of pose covariances (N, 3, 3)."""
    return np.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])


def single(scene: Scene, poses: Array) -> Array:
    """(N, 3, 3) bound on the pose covariance after one scan, without prior knowledge."""
    return np.asarray(np.linalg.inv(information(scene, poses)), np.float64)


def heading_known(covariance: Array) -> Array:
    """Bounds (..., 3, 3) of an estimator that knows the heading, from bounds of one that also estimates it."""
    position_bound = np.zeros_like(covariance)
    position_bound[..., :2, :2] = np.linalg.inv(np.linalg.inv(covariance)[..., :2, :2])
    return position_bound


def median_error(covariance: Array) -> float:
    """Median distance, m, of Gaussian errors drawn equally often from each of the covariances (N, 3, 3)."""
    spread = np.linalg.cholesky(covariance[:, :2, :2])
    draws = np.random.default_rng(0).standard_normal((2000, 2))
    return float(np.median(np.linalg.norm(np.einsum("nij,kj->nki", spread, draws), axis=-1)))


def recursive(scene: Scene, path: Array, drift: OdometryNoise, start: Array | None = None) -> Array:
    """(N, 3, 3) bound along a path (N, 3) with odometry of the given drift: an information filter at the true poses.

    ``start`` (3, 3) is the pose covariance before the first scan. Defaults to no prior knowledge.
    """
    bounds, predicted = [], np.zeros((3, 3)) if start is None else np.linalg.inv(start)
    for k, measured in enumerate(information(scene, path)):
        covariance = np.linalg.inv(measured + predicted)
        bounds.append(covariance)
        if k + 1 < len(path):
            step = se2.between(path[k], path[k + 1])
            length, turn = float(np.hypot(step[0], step[1])), abs(float(step[2]))
            along = drift.path_by_path * length + drift.path_by_turn * turn
            around = drift.turn_by_turn * turn + drift.turn_by_path * length
            pose_jacobian, step_jacobian = se2.compose_jacobians(path[k], step)
            spread = (step_jacobian * np.array([along, along, around])) @ step_jacobian.T
            predicted = np.linalg.inv(pose_jacobian @ covariance @ pose_jacobian.T + spread + 1e-14 * np.eye(3))
    return np.array(bounds)
