"""Variational free energy and its descent directions (docs/method.md).

Symbols as in the paper: o measured ranges (B,) m, g = g(belief) expected ranges (B,) m, dg (B, 3) its derivative,
precision (B,) 1/m², the diagonal of the inverse of Sigma_o.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array


@dataclass(frozen=True)
class Gradient:
    """F at a belief, and where it falls."""

    accuracy: float  # nats, -ln N(o; g, Sigma_o)
    attraction: float  # nats, beta-weighted misfit between what is expected here and at the goal
    xi: Array  # (3,) dg' Sigma_o^-1 (o - g), minus the gradient of accuracy
    xi_goal: Array  # (3,) minus the gradient of attraction
    curvature: Array  # (3, 3) dg' Sigma_o^-1 dg, Gauss-Newton Hessian of accuracy

    @property
    def descent(self) -> Array:
        """(3,) minus the gradient of F: the direction of equation 3 with the signs of descent."""
        return self.xi + self.xi_goal


def accuracy(o: Array, g: Array, precision: Array) -> float:
    """-ln N(o; g, diag(1 / precision)) in nats, the whole density with its constant."""
    return float(0.5 * np.sum(precision * (o - g) ** 2 - np.log(precision / (2 * np.pi))))


def attraction(g: Array, g_goal: Array, precision: Array, beta: float) -> float:
    """beta/2 (g_goal - g)' Sigma^-1 (g_goal - g) in nats: how unlike the preferred scan the expected one is."""
    return float(0.5 * beta * np.sum(precision * (g_goal - g) ** 2))


def gradient(
    o: Array, g: Array, dg: Array, precision: Array, g_goal: Array | None = None, beta: float = 0.0
) -> Gradient:
    """Equation 3 of the paper, both terms, with the signs that descend F.

    As printed the goal term is + beta dg' Sigma^-1 (o - g_goal), which to first order is beta H (x - x_goal): away
    from the goal. Minus the gradient of `attraction` is + beta dg' Sigma^-1 (g_goal - g).
    """
    weighted = dg.T * precision
    pull = weighted @ (g_goal - g) * beta if g_goal is not None else np.zeros(3)
    return Gradient(
        accuracy=accuracy(o, g, precision),
        attraction=attraction(g, g_goal, precision, beta) if g_goal is not None else 0.0,
        xi=weighted @ (o - g),
        xi_goal=pull,
        curvature=weighted @ dg,
    )
