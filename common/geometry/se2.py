"""Poses in the plane, SE(2): compose, invert, transform points (REP-103 conventions)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def wrap(angle: npt.ArrayLike) -> Array:
    """Angles in rad of any shape, wrapped to [-pi, pi)."""
    a = np.asarray(angle, float)
    wrapped = (a + np.pi) % (2 * np.pi) - np.pi
    # The remainder of a tiny negative number is rounded up to 2 pi.
    return np.asarray(np.where(wrapped >= np.pi, wrapped - 2 * np.pi, wrapped))


def compose(a: npt.ArrayLike, b: npt.ArrayLike) -> Array:
    """Pose ``b``, given in frame ``a``, expressed in the parent frame of ``a``; shapes (..., 3) broadcast."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    composed = np.empty((*x.shape, 3))
    composed[..., 0] = x
    composed[..., 1] = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    composed[..., 2] = wrap(a[..., 2] + b[..., 2])
    return composed


def inverse(a: npt.ArrayLike) -> Array:
    """Inverse pose, for which compose(a, inverse(a)) = 0; shape (..., 3)."""
    a = np.asarray(a, float)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [-cos * a[..., 0] - sin * a[..., 1], sin * a[..., 0] - cos * a[..., 1], wrap(-a[..., 2])],
        axis=-1,
    )


def between(a: npt.ArrayLike, b: npt.ArrayLike) -> Array:
    """Pose of ``b`` relative to ``a``, for which compose(a, between(a, b)) = b; shapes (..., 3) broadcast."""
    return compose(inverse(a), b)


def known_pose(poses: Array | None, index: int) -> Array | None:
    """The pose (3,) at an index of ``poses`` (N, 3). Returns None if there are no poses, or this one is not finite."""
    return None if poses is None or not np.isfinite(poses[index]).all() else poses[index]


def difference(a: Array, b: Array) -> Array:
    """Componentwise a - b of poses (..., 3), with the angle wrapped."""
    off = a - b
    off[..., 2] = wrap(off[..., 2])
    return off


def compose_jacobians(a: npt.ArrayLike, b: npt.ArrayLike) -> tuple[Array, Array]:
    """Derivatives of compose(a, b) with respect to a and b, each (3, 3), for poses (3,)."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    cos, sin = np.cos(a[2]), np.sin(a[2])
    by_a = np.array(
        [[1.0, 0.0, -sin * b[0] - cos * b[1]], [0.0, 1.0, cos * b[0] - sin * b[1]], [0.0, 0.0, 1.0]],
    )
    by_b = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return by_a, by_b


def displacement_jacobian(offsets: Array, directions: Array) -> Array:
    """Derivatives (K, 3) by a pose's x, y, yaw of points fixed to it, along unit vectors ``directions`` (K, 2).

    ``offsets`` (K, 2) m are the points relative to the position of the pose; both in the parent frame.
    """
    turned = directions[:, 1] * offsets[:, 0] - directions[:, 0] * offsets[:, 1]
    return np.column_stack([directions, turned])


def rotate(yaw: float, vector: npt.ArrayLike) -> Array:
    """Vectors (..., 2) rotated by ``yaw`` rad counter-clockwise."""
    v = np.asarray(vector, float)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([cos * v[..., 0] - sin * v[..., 1], sin * v[..., 0] + cos * v[..., 1]], axis=-1)


def rotation(yaw: float) -> Array:
    """Matrix R (3, 3) that turns x and y by ``yaw`` rad; R C R.T turns a covariance C of x, y, yaw into the parent."""
    matrix = np.eye(3)
    matrix[:2, :2] = rotate(yaw, np.eye(2)).T
    return matrix


def transform(pose: npt.ArrayLike, points: npt.ArrayLike) -> Array:
    """Transforms points (..., 2) in m from the frame with the given ``pose`` (3,) to its parent frame."""
    p = np.asarray(pose, float)
    return np.asarray(p[:2] + rotate(float(p[2]), points))


def alignment(poses: Array, targets: Array) -> Array:
    """Rigid transform (3,) that brings the positions of ``poses`` (N, 3) closest to those of ``targets``.

    Least squares of the distances, in closed form (Horn 1987 in the plane); headings are ignored.
    """
    mean, target_mean = poses[:, :2].mean(axis=0), targets[:, :2].mean(axis=0)
    a, b = poses[:, :2] - mean, targets[:, :2] - target_mean
    turn = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
    return np.array([*(target_mean - rotate(turn, mean)), turn])
