"""Variational free energy and its descent directions (docs/method.md).

Symbols as in the paper: o measured ranges (B,) m, g = g(belief) expected ranges (B,) m, dg (B, 3) its derivative,
precision (B,) 1/m², the diagonal of the inverse of Sigma_o.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array


def accuracy(o: Array, g: Array, precision: Array) -> float:
    """-ln N(o; g, diag(1 / precision)) in nats, including the constant."""
    return float(0.5 * np.sum(precision * (o - g) ** 2 - np.log(precision / (2 * np.pi))))


def attraction(g: Array, g_goal: Array, precision: Array, beta: float) -> float:
    """beta/2 (g_goal - g)' Sigma^-1 (g_goal - g) in nats, the distance of the expected scan from the preferred one."""
    return float(0.5 * beta * np.sum(precision * (g_goal - g) ** 2))


@dataclass(frozen=True)
class FreeEnergy:
    """The terms of F at a belief, and their derivatives; each is computed when it is used."""

    o: Array  # (B,) m
    g: Array  # (B,) m
    dg: Array  # (B, 3) m/m, m/m, m/rad
    precision: Array  # (B,) 1/m²
    g_goal: Array | None = None  # (B,) m, ranges expected at the goal
    beta: float = 0.0

    @property
    def accuracy(self) -> float:
        """See `accuracy`."""
        return accuracy(self.o, self.g, self.precision)

    @property
    def attraction(self) -> float:
        """See `attraction`; 0 without a goal."""
        return attraction(self.g, self.g_goal, self.precision, self.beta) if self.g_goal is not None else 0.0

    @cached_property
    def _weighted(self) -> Array:
        return np.asarray(self.dg.T * self.precision)

    @property
    def xi(self) -> Array:
        """Minus the gradient of accuracy (3,): dg' Sigma_o^-1 (o - g)."""
        return np.asarray(self._weighted @ (self.o - self.g))

    @property
    def xi_goal(self) -> Array:
        """Minus the gradient of attraction (3,): + beta dg' Sigma^-1 (g_goal - g).

        The goal term of equation 3 as printed is + beta dg' Sigma^-1 (o - g_goal). To first order this is beta H (x -
        x_goal), which points away from the goal.
        """
        return self._weighted @ (self.g_goal - self.g) * self.beta if self.g_goal is not None else np.zeros(3)

    @property
    def descent(self) -> Array:
        """Minus the gradient of F (3,): the direction of equation 3 with the signs of descent."""
        return self.xi + self.xi_goal

    @property
    def curvature(self) -> Array:
        """Gauss-Newton Hessian of accuracy (3, 3): dg' Sigma_o^-1 dg."""
        return np.asarray(self._weighted @ self.dg)
