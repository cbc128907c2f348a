"""The Cramér-Rao bound (Censi 2007)."""

from __future__ import annotations

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from lab.accuracy.scenes import Scene
from services.estimator.shared.generative_models import RayCaster
from services.simulator.odometry import Drift

TINY = 1e-9  # 1/m², so that a direction of which a scan says nothing has a bound, a very large one


def information(scene: Scene, poses: Array) -> Array:
    """(N, 3, 3) Fisher information of one scan about base_link: sum of J'J / sigma² over beams, from exact rays.

    Beams that the scanner's longest range ends count for nothing, as what noise that grows with the range tells of the
    range besides.
    """
    mount = np.array(scene.scanner.mount)
    lasers = se2.compose(poses, mount)
    expected = RayCaster(scene.world).expect(lasers, scene.scanner.angles())
    seen = (expected.ranges >= scene.scanner.range_min) & (expected.ranges <= scene.scanner.range_max)
    J = np.where(seen[..., None], expected.jacobian, 0)
    J[..., 2] += J[..., 0] * (poses[:, 1] - lasers[:, 1])[:, None] + J[..., 1] * (lasers[:, 0] - poses[:, 0])[:, None]
    weighed = J / scene.scanner.deviation(np.where(seen, expected.ranges, 0.0))[..., None] ** 2
    return np.asarray(np.einsum("nbi,nbj->nij", weighed, J) + TINY * np.eye(3))


def position(covariance: Array) -> Array:
    """(N,) m, root of the expected squared distance, of covariances (N, 3, 3)."""
    return np.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])


def single(scene: Scene, poses: Array, scans: int = 1) -> Array:
    """(N, 3, 3) bound on the covariance from so many scans of a robot that stands."""
    return np.asarray(np.linalg.inv(information(scene, poses) * scans), np.float64)


def heading_known(covariance: Array) -> Array:
    """(..., 3, 3) bounds as they are for those who know the heading: nothing is lost on estimating it."""
    found = np.zeros_like(covariance)
    found[..., :2, :2] = np.linalg.inv(np.linalg.inv(covariance)[..., :2, :2])
    return found


def median(covariance: Array) -> float:
    """M, the median distance of Gaussian errors with these covariances (N, 3, 3), all of them equally often."""
    spread = np.linalg.cholesky(covariance[:, :2, :2])
    draws = np.random.default_rng(0).standard_normal((2000, 2))
    return float(np.median(np.linalg.norm(np.einsum("nij,kj->nki", spread, draws), axis=-1)))


def recursive(scene: Scene, path: Array, drift: Drift, start: Array | None = None) -> Array:
    """(N, 3, 3) bound along a path (N, 3) with odometry of that drift: the information filter at the true poses.

    ``start`` (3, 3) is the covariance of what is known before the first scan; None: nothing is.
    """
    found, carried = [], np.zeros((3, 3)) if start is None else np.linalg.inv(start)
    for k, own in enumerate(information(scene, path)):
        total = own + carried
        covariance = np.linalg.inv(total)
        found.append(covariance)
        if k + 1 < len(path):
            step = se2.between(path[k], path[k + 1])
            length, turn = float(np.hypot(step[0], step[1])), abs(float(step[2]))
            along = drift.path_by_path * length + drift.path_by_turn * turn
            around = drift.turn_by_turn * turn + drift.turn_by_path * length
            by_pose, by_step = se2.compose_jacobians(path[k], step)
            spread = (by_step * np.array([along, along, around])) @ by_step.T
            carried = np.linalg.inv(by_pose @ covariance @ by_pose.T + spread + 1e-14 * np.eye(3))
    return np.array(found)
