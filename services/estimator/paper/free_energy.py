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
    """Parts of F at a belief, and their gradients."""

    accuracy: float  # nats, -ln N(o; g, Sigma_o)
    attraction: float  # nats, beta-weighted difference between the scans expected here and at the goal
    xi: Array  # (3,) dg' Sigma_o^-1 (o - g), minus the gradient of accuracy
    xi_goal: Array  # (3,) minus the gradient of attraction
    curvature: Array  # (3, 3) dg' Sigma_o^-1 dg, Gauss-Newton Hessian of accuracy

    @property
    def descent(self) -> Array:
        """Minus the gradient of F (3,): the direction of equation 3 with the signs of descent."""
        return self.xi + self.xi_goal


def accuracy(o: Array, g: Array, precision: Array) -> float:
    """-ln N(o; g, diag(1 / precision)) in nats, including the constant."""
    return float(0.5 * np.sum(precision * (o - g) ** 2 - np.log(precision / (2 * np.pi))))


def attraction(g: Array, g_goal: Array, precision: Array, beta: float) -> float:
    """beta/2 (g_goal - g)' Sigma^-1 (g_goal - g) in nats, the distance of the expected scan from the preferred one."""
    return float(0.5 * beta * np.sum(precision * (g_goal - g) ** 2))


def gradient(
    o: Array, g: Array, dg: Array, precision: Array, g_goal: Array | None = None, beta: float = 0.0
) -> Gradient:
    """Both terms of equation 3 of the paper, with the signs that descend F.

    The goal term as printed is + beta dg' Sigma^-1 (o - g_goal). To first order this is beta H (x - x_goal), which
    points away from the goal. Minus the gradient of `attraction` is + beta dg' Sigma^-1 (g_goal - g).
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
