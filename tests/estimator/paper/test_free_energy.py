"""F and its descent directions compared with finite differences and with the signs printed in the paper."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.estimator.paper.free_energy import FreeEnergy, accuracy, attraction

seeds = st.integers(0, 2**32 - 1)


def scene(seed: int):
    """A smooth random generative model g(x) = A sin(Bx + c), its derivative, a scan and precisions."""
    rng = np.random.default_rng(seed)
    beams = 40
    A, B, c = rng.normal(0, 2, beams), rng.normal(0, 0.5, (beams, 3)), rng.uniform(0, 6, beams)

    def g(x):
        return A * np.sin(B @ x + c)

    def dg(x):
        return (A * np.cos(B @ x + c))[:, None] * B

    truth, belief, goal = rng.normal(0, 0.5, (3, 3))
    precision = rng.uniform(0.2, 5.0, beams)
    return g, dg, g(truth) + 0.02 * rng.normal(size=beams), precision, belief, goal


def free_energy(g, o, precision, x, goal, beta):
    return accuracy(o, g(x), precision) + attraction(g(x), g(goal), precision, beta)


@given(seeds, st.floats(0.01, 2.0))
def test_descent(seed, beta):
    g, dg, o, precision, belief, goal = scene(seed)
    found = FreeEnergy(o, g(belief), dg(belief), precision, g(goal), beta)
    h = 1e-6
    for axis in range(3):
        step = h * np.eye(3)[axis]
        f = [free_energy(g, o, precision, belief + s * step, goal, beta) for s in (1, -1)]
        assert found.descent[axis] == pytest.approx(-(f[0] - f[1]) / (2 * h), rel=1e-4, abs=1e-4)


@given(seeds)
def test_curvature(seed):
    g, dg, _, precision, belief, _ = scene(seed)
    found = FreeEnergy(g(belief), g(belief), dg(belief), precision)  # without misfit the Gauss-Newton Hessian is exact
    h = 1e-4
    for i in range(3):
        for j in range(3):
            ei, ej = h * np.eye(3)[i], h * np.eye(3)[j]
            f = {(a, b): accuracy(g(belief), g(belief + a * ei + b * ej), precision) for a in (1, -1) for b in (1, -1)}
            numeric = (f[1, 1] - f[1, -1] - f[-1, 1] + f[-1, -1]) / (4 * h * h)
            assert found.curvature[i, j] == pytest.approx(numeric, rel=1e-3, abs=1e-2)


def test_accuracy_is_a_density():
    """exp(-accuracy) integrates to one over all measurements: there is no gain and no factor 1/N."""
    for precision in (0.25, 1.0, 2500.0):
        sigma = precision**-0.5
        o = np.linspace(-12 * sigma, 12 * sigma, 20001)
        density = [np.exp(-accuracy(np.array([v]), np.zeros(1), np.array([precision]))) for v in o[::10]]
        assert np.sum(density) * (o[10] - o[0]) == pytest.approx(1.0, rel=1e-6)


@given(seeds)
def test_printed_goal_term(seed):
    """The goal term as printed, beta dg' Pi (o - g_goal), ascends F near the goal if the belief is the true pose."""
    g, dg, _, precision, belief, _ = scene(seed)
    goal = belief + 1e-3 * np.random.default_rng(seed).normal(size=3)
    o = g(belief)
    printed = (dg(belief).T * precision) @ (o - g(goal))
    ours = FreeEnergy(o, g(belief), dg(belief), precision, g(goal), 1.0).xi_goal
    assert printed @ (goal - belief) < 0 < ours @ (goal - belief)
