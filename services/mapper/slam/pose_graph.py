"""Pose graph: the poses that agree best with all links between them (Lu & Milios 1997).

A sparse Gauss-Newton method with scipy. The library gtsam does the same, but weighs 34 MB and installs pytest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from common.geometry import se2
from common.geometry.se2 import Array

MAX_STEPS = 20  # of Gauss-Newton
CONVERGED = 1e-5  # m and rad
ANCHOR = 1e8  # information that holds the first pose of each component
ROBUST_SCALE = 3.0  # standard deviations, of the Cauchy weights of robust links


@dataclass(frozen=True)
class PoseLink:
    """Measured pose (3,) of pose number ``second`` in the frame of ``first``, with its information (3, 3)."""

    first: int
    second: int
    pose: Array
    information: Array
    robust: bool = False  # whether the link may be wrong


class LinkTable:
    """Links as arrays."""

    def __init__(self, links: Sequence[PoseLink]) -> None:
        self.first = np.array([link.first for link in links], int)
        self.second = np.array([link.second for link in links], int)
        self.poses = np.array([link.pose for link in links]).reshape(-1, 3)
        self.information = np.array([link.information for link in links]).reshape(-1, 3, 3)
        self.robust = np.array([link.robust for link in links], bool)

    def errors(self, poses: Array) -> Array:
        """Errors (L, 3) of the links at poses (N, 3), in the frame of the first pose of each."""
        return se2.difference(se2.between(poses[self.first], poses[self.second]), self.poses)

    def squared_deviations(self, poses: Array) -> Array:
        """Squared Mahalanobis distances (L,) of the links at poses (N, 3)."""
        error = self.errors(poses)
        return np.asarray(np.einsum("li,lij,lj->l", error, self.information, error))

    def jacobians(self, poses: Array) -> tuple[Array, Array]:
        """Derivatives (L, 3, 3) of `errors` with respect to the first and the second pose of each link."""
        return _relative_jacobians(poses[self.first], poses[self.second])

    def normal_equations(self, poses: Array) -> tuple[sparse.csc_array, Array]:
        """Hessian (3 N, 3 N) and gradient (3 N,) of half the sum of the squared deviations, robustly weighted."""
        deviation = self.squared_deviations(poses)
        weight = np.where(self.robust, 1 / (1 + deviation / ROBUST_SCALE**2), 1.0)
        information, error = weight[:, None, None] * self.information, self.errors(poses)
        sides = list(zip((self.first, self.second), self.jacobians(poses), strict=True))
        gradient = np.zeros((len(poses), 3))
        blocks, rows, columns = [], [], []
        for i, by_i in sides:
            np.add.at(gradient, i, np.einsum("lki,lkj,lj->li", by_i, information, error))
            for j, by_j in sides:
                blocks.append(np.einsum("lki,lkm,lmj->lij", by_i, information, by_j))
                rows.append(i)
                columns.append(j)
        hessian = _block_matrix(np.concatenate(blocks), np.concatenate(rows), np.concatenate(columns), len(poses))
        return hessian, gradient.ravel()


def optimise(poses: Array, links: Sequence[PoseLink]) -> Array:
    """The poses (N, 3) that minimise the squared deviations of the links; the first of each component stays."""
    table, poses = LinkTable(links), poses.copy()
    component = components(len(poses), links)
    for _ in range(MAX_STEPS):
        hessian, gradient = table.normal_equations(poses)
        step = _factorise_anchored(hessian, component).solve(-gradient).reshape(-1, 3)
        poses += step
        poses[:, 2] = se2.wrap(poses[:, 2])
        if np.abs(step).max() < CONVERGED:
            break
    return poses


class Uncertainty:
    """Covariances between some poses of a graph (linearised).

    The Hessian is factorised once; the inverse is computed column by column, where it is needed.
    """

    def __init__(self, poses: Array, links: Sequence[PoseLink], chosen: npt.NDArray[np.integer]) -> None:
        component = components(len(poses), links)
        self._factor = _factorise_anchored(LinkTable(links).normal_equations(poses)[0], component)
        self._poses, self._chosen, self._component = poses, np.asarray(chosen), component[chosen]
        self._columns: dict[int, Array] = {}  # (C, 3, 3) covariances of all chosen poses with one

    def linked(self, first: int, second: int) -> bool:
        """Whether links connect two chosen poses; otherwise nothing is known of their relative pose."""
        return bool(self._component[first] == self._component[second])

    def of_pair(self, first: int, second: int) -> Array:
        """Covariance (3, 3) of the pose of a chosen pose in the frame of another, by their numbers."""
        by_first, by_second = _relative_jacobians(*self._poses[self._chosen[[first, second]]])
        a, b = self._column(first), self._column(second)
        cross = by_first @ b[first] @ by_second.T
        return np.asarray(by_first @ a[first] @ by_first.T + cross + cross.T + by_second @ b[second] @ by_second.T)

    def _column(self, number: int) -> Array:
        if number not in self._columns:
            unit = np.zeros((len(self._poses), 3, 3))
            unit[self._chosen[number]] = np.eye(3)
            self._columns[number] = self._factor.solve(unit.reshape(-1, 3)).reshape(-1, 3, 3)[self._chosen]
        return self._columns[number]


def components(count: int, links: Sequence[PoseLink]) -> npt.NDArray[np.int_]:
    """Labels (N,) of poses; those that links connect have the same one."""
    pairs = np.array([(link.first, link.second) for link in links], int).reshape(-1, 2)
    graph = sparse.coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], int)


def _factorise_anchored(hessian: sparse.csc_array, component: npt.NDArray[np.int_]) -> SuperLU:
    """Factorises a Hessian (3 N, 3 N) with the first pose of each component (N,) held in place."""
    anchor = np.zeros((len(component), 3))
    anchor[np.unique(component, return_index=True)[1]] = ANCHOR
    return splu((hessian + sparse.diags_array(anchor.ravel())).tocsc())


def _block_matrix(blocks: Array, rows: Array, columns: Array, count: int) -> sparse.csc_array:
    """Sparse matrix (3 count, 3 count) that sums blocks (M, 3, 3) at block rows (M,) and columns (M,)."""
    i = np.broadcast_to(3 * rows[:, None, None] + np.arange(3)[:, None], blocks.shape)
    j = np.broadcast_to(3 * columns[:, None, None] + np.arange(3), blocks.shape)
    return sparse.coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=(3 * count, 3 * count)).tocsc()


def _relative_jacobians(first: Array, second: Array) -> tuple[Array, Array]:
    """Derivatives (..., 3, 3) of poses ``second`` in the frames of ``first``, both (..., 3), with respect to each."""
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x, y = np.moveaxis((second - first)[..., :2], -1, 0)
    by_second = np.zeros((*first.shape, 3))
    by_second[..., 0, 0] = by_second[..., 1, 1] = cos
    by_second[..., 0, 1], by_second[..., 1, 0], by_second[..., 2, 2] = sin, -sin, 1.0
    by_first = -by_second
    by_first[..., 0, 2], by_first[..., 1, 2] = cos * y - sin * x, -cos * x - sin * y
    return by_first, by_second
