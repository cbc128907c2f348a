"""Equation 4: gradients against finite differences, and convergence."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry import se2
from services.controller.policies.paper_action import (
    MAX_CORRECTION_M,
    ActionParameters,
    action_gradient,
    next_action,
    observed_position,
    preferred_position,
)

pair = st.tuples(*[st.floats(-5, 5)] * 2).map(np.array)
angle = st.floats(-np.pi, np.pi)
parameter_sets = st.builds(
    ActionParameters,
    gamma=st.floats(0.01, 0.45),
    horizon=st.floats(0.2, 2.0),
    reach=st.floats(0.1, 3.0),
    action_precision=st.floats(0.1, 3.0),
)


def action_free_energy(action, observed, preferred, yaw, parameters):
    outcome = observed + parameters.horizon * se2.rotate(yaw, action)
    misfit, effort = outcome - preferred, parameters.action_precision * parameters.horizon**2
    return float(0.5 * misfit @ misfit + 0.5 * effort * action @ action)


@given(pair, pair, pair, angle, parameter_sets)
def test_gradient_matches_finite_differences(action, observed, preferred, yaw, parameters):
    def free_energy(action):
        return action_free_energy(action, observed, preferred, yaw, parameters)

    h = 1e-5 * np.eye(2)
    differences = [(free_energy(action + step) - free_energy(action - step)) / 2e-5 for step in h]
    found = action_gradient(action, observed, preferred, yaw, parameters)
    assert found == pytest.approx(differences, rel=1e-5, abs=1e-5)


@given(pair, pair, pair, angle, st.floats(0.01, 0.45))
def test_each_step_lowers_the_free_energy(action, observed, preferred, yaw, gamma):
    rest = observed, preferred, yaw, ActionParameters(gamma=gamma)
    before, after = (action_free_energy(a, *rest) for a in (action, next_action(action, *rest)))
    assert after <= before
    if np.linalg.norm(action_gradient(action, *rest)) > 1e-3:
        assert after < before


@given(pair, pair, angle)
def test_action_converges_to_half_the_way(observed, preferred, yaw):
    """Half, because the prior on standing still has the same precision."""
    action = np.zeros(2)
    for _ in range(100):
        action = next_action(action, observed, preferred, yaw, ActionParameters())
    assert se2.rotate(yaw, action) == pytest.approx((preferred - observed) / 2, abs=1e-6)


def test_correction_of_the_belief():
    """For a linear generative model, the belief plus H^-1 xi is the truth."""
    J = np.random.default_rng(0).normal(size=(50, 3))
    J[:, 2] = 0
    truth, pose = np.array([2.0, 1.0, 0.0]), np.array([1.9, 1.1, 0.0])
    found = observed_position(pose, J.T @ (J @ (truth - pose)), J.T @ J)
    assert found == pytest.approx(truth[:2], abs=1e-3)


def test_no_curvature_or_information():
    pose = np.array([1.0, 2.0, 0.0])
    assert observed_position(pose, np.array([100.0, 0, 0]), None) == pytest.approx(pose[:2])
    assert observed_position(pose, None, np.eye(3)) == pytest.approx(pose[:2])
    bare_corridor = np.diag([400.0, 0.0, 0.0])  # without information along y
    assert observed_position(pose, np.array([40.0, 0, 0]), bare_corridor) == pytest.approx([1.1, 2.0], abs=1e-3)


@given(pair, st.floats(1e-3, 1e6))
def test_bounded_corrections(xi, scale):
    found = observed_position(np.zeros(3), np.array([*xi, 0]) * scale, np.diag([1.0, 1.0, 0.0]))
    assert np.linalg.norm(found) <= MAX_CORRECTION_M + 1e-9
    assert np.linalg.norm(preferred_position(found, np.array([100.0, 50.0, 0]), 1.0) - found) == pytest.approx(1.0)
    assert preferred_position(found, np.array([*found, 0]), 1.0) == pytest.approx(found)
