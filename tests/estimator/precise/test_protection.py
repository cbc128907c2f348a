"""The error of an estimate: the pose without each surface, the covariance, and the protection level."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr  # scipy.stats takes long to import

from common.geometry import se2
from services.estimator.precise.hypotheses import WEAK_PRIOR
from services.estimator.precise.protection import (
    EXCEEDANCE_PROBABILITY,
    MISTAKEN_FRACTION,
    EstimateError,
    _estimate_without_each_surface,
)
from tests.estimator.precise.test_inference import TRUTH, scan, view

COVARIANCE = np.diag([0.002, 0.001, 0.003]) ** 2


@pytest.fixture
def matched():
    made = view(scan(TRUTH, np.random.default_rng(3)))
    pose = made.descend(TRUTH[None])[0][0]
    return made, pose


def test_evidence_of_each_surface(matched):
    made, pose = matched
    by_surface = made.evidence_of_each_surface(pose)
    weights = made.surface_evidence(pose[None]).weights * ~made.surfaces.small
    together = made.evidence(pose[None], weights=weights)
    assert len(by_surface.xi) > 2
    assert by_surface.xi.sum(axis=0) == pytest.approx(together.xi[0])
    assert by_surface.curvature.sum(axis=0) == pytest.approx(together.curvature[0])


def test_pose_without_each_surface(matched):
    made, pose = matched
    evidence = made.evidence_of_each_surface(pose)
    offsets, widening = _estimate_without_each_surface(evidence, se2.rotation(-float(pose[2])))

    def solution(used):
        information = evidence.curvature[used].sum(axis=0) + WEAK_PRIOR
        return np.linalg.solve(information, evidence.xi[used].sum(axis=0)), np.linalg.inv(information)

    everything = np.arange(len(evidence.xi))
    reference, covariance = solution(everything)
    for k in everything:
        moved, wider = solution(everything[everything != k])
        in_base = np.array([*se2.rotate(-float(pose[2]), (moved - reference)[:2]), (moved - reference)[2]])
        assert offsets[k] == pytest.approx(in_base)
        assert widening[k, 2] == pytest.approx(np.sqrt(wider[2, 2] / covariance[2, 2]))
    assert (widening >= 1).all()


def test_moments_and_level_of_a_mixture():
    deviation, offsets = np.array([1.0, 2.0, 0.5]), np.array([[8.0, 0.0, 1.0], [3.0, -5.0, 0.0]])
    widening = np.array([[1.5, 1.0, 2.0], [1.0, 3.0, 1.0]])
    error = EstimateError(np.diag(deviation**2), offsets, widening, 0.01)
    level = error.protection_level(0.4 * EXCEEDANCE_PROBABILITY)
    beyond = 2 * ndtr(-level / deviation)
    for offset, factor in zip(offsets, widening, strict=True):
        beyond += 0.01 * sum(ndtr((side * offset - level) / (deviation * factor)) for side in (-1, 1))
    assert beyond == pytest.approx(0.6 * EXCEEDANCE_PROBABILITY, rel=1e-3)
    spread = np.diag(deviation**2) + 0.01 * (np.outer(offsets[0], offsets[0]) + np.outer(offsets[1], offsets[1]))
    assert error.total_covariance(0.0) == pytest.approx(spread)
    assert error.total_covariance(0.5 * np.pi)[1, 1] == pytest.approx(spread[0, 0])


def error_of(scan_view, pose, explained=1.0):
    return EstimateError.from_scan(scan_view, pose, COVARIANCE, explained)


def test_elsewhere(matched):
    near = error_of(*matched).protection_level(0.0)
    assert (near >= 3.89 * np.sqrt(np.diag(COVARIANCE)).min()).all()
    assert (error_of(*matched).protection_level(0.5 * EXCEEDANCE_PROBABILITY) > near).all()
    assert error_of(*matched).protection_level(EXCEEDANCE_PROBABILITY) is None


def test_few_explained_surfaces(matched):
    assert error_of(*matched, 1.0).mistaken == MISTAKEN_FRACTION
    assert error_of(*matched, 0.1).mistaken == pytest.approx(10 * MISTAKEN_FRACTION)
    assert error_of(*matched, 0.0).mistaken == 1.0
    assert (error_of(*matched, 0.1).protection_level(0.0) > error_of(*matched, 1.0).protection_level(0.0)).all()


def test_no_surface(matched):
    made, pose = matched
    error = error_of(view(np.full_like(made.ranges, np.nan)), pose * [1, 1, 0])
    assert error.protection_level(0.0) == pytest.approx(3.8906 * np.sqrt(np.diag(COVARIANCE)), rel=1e-3)
    assert error.total_covariance(0.0) == pytest.approx(COVARIANCE)


def test_mistaken_surfaces(matched):
    """Things that stand 4 cm off drag the estimate farther than its covariance says; the level allows for most."""
    made, pose = matched
    surface = np.cumsum(made.surfaces.starts) * ~made.surfaces.small
    beyond = {"level": 0, "covariance": 0}
    for k in np.flatnonzero(np.bincount(surface)[1:] > 5) + 1:
        dragged = view(made.ranges + 0.04 * (surface == k))
        wrong = dragged.descend(pose[None])[0][0]
        error = np.abs(se2.between(wrong, pose))
        beyond["level"] += (error > error_of(dragged, wrong).protection_level(0.0)).any()
        beyond["covariance"] += (error > 3.89 * np.sqrt(np.diag(COVARIANCE))).any()
    assert beyond["level"] < beyond["covariance"] / 2, beyond
