"""Protection levels: the pose without each surface, and errors that are exceeded with the probability asked for."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from services.estimator.precise import protection
from services.estimator.precise.hypotheses import WEAK_PRIOR
from tests.estimator.precise.test_inference import TRUTH, scan, view

COVARIANCE = np.diag([0.002, 0.001, 0.003]) ** 2


@pytest.fixture
def matched():
    made = view(scan(TRUTH, np.random.default_rng(3)))
    pose = made.descend(TRUTH[None])[0][0]
    return made, pose


def test_evidence_by_surface(matched):
    made, pose = matched
    by_surface = made.evidence_by_surface(pose)
    weights = made.surface_evidence(pose[None]).weights * ~made.surfaces.small
    together = made.evidence(pose[None], attention=weights)
    assert len(by_surface.xi) > 2
    assert by_surface.xi.sum(axis=0) == pytest.approx(together.xi[0])
    assert by_surface.curvature.sum(axis=0) == pytest.approx(together.curvature[0])


def test_pose_without_each_surface(matched):
    made, pose = matched
    evidence = made.evidence_by_surface(pose)
    offsets, widening = protection._without_each_surface(evidence, se2.rotation(-float(pose[2])))

    def solution(used):
        information = evidence.curvature[used].sum(axis=0) + WEAK_PRIOR
        return np.linalg.solve(information, evidence.xi[used].sum(axis=0)), np.linalg.inv(information)

    everything = np.arange(len(evidence.xi))
    reference, covariance = solution(everything)
    for k in everything:
        moved, wider = solution(everything[everything != k])
        in_base = np.array([*se2.rotate(-float(pose[2]), (moved - reference)[:2]), (moved - reference)[2]])
        assert offsets[k] == pytest.approx(np.abs(in_base))
        assert widening[k, 2] == pytest.approx(np.sqrt(wider[2, 2] / covariance[2, 2]))
    assert (widening >= 1).all()


def test_level_of_a_mixture():
    rng = np.random.default_rng(4)
    deviation, offsets = np.array([1.0, 2.0, 0.5]), np.array([[8.0, 0.0, 1.0], [3.0, 5.0, 0.0]])
    deviations = deviation * np.array([[1.5, 1.0, 2.0], [1.0, 3.0, 1.0]])
    level, count = protection._level(deviation, offsets, deviations, 0.005), 400_000
    share = np.mean(np.abs(rng.normal(0, deviation, (count, 3))) > level, axis=0)
    for offset, each in zip(offsets, deviations, strict=True):
        beyond = np.abs(rng.normal(offset, each, (count, 3))) > level
        share += protection.MISTAKEN_SURFACE * beyond.mean(axis=0)
    assert share == pytest.approx(0.005, abs=0.0006)


def test_elsewhere(matched):
    made, pose = matched
    near = protection.protection_level(made, pose, COVARIANCE, 0.0)
    assert (near >= 3.89 * np.sqrt(np.diag(COVARIANCE)).min()).all()
    assert (protection.protection_level(made, pose, COVARIANCE, 0.5 * protection.EXCEEDED_SHARE) > near).all()
    assert protection.protection_level(made, pose, COVARIANCE, protection.EXCEEDED_SHARE) is None


def test_no_surface(matched):
    made, pose = matched
    nothing = view(np.full_like(made.ranges, np.nan))
    level = protection.protection_level(nothing, pose * [1, 1, 0], COVARIANCE, 0.0)
    assert level == pytest.approx(3.8906 * np.sqrt(np.diag(COVARIANCE)), rel=1e-3)


def test_mistaken_surfaces(matched):
    """Things that stand 4 cm off drag the estimate farther than its covariance says; the level allows for most."""
    made, pose = matched
    surface = np.cumsum(made.surfaces.starts) * ~made.surfaces.small
    beyond = {"level": 0, "covariance": 0}
    for k in np.flatnonzero(np.bincount(surface)[1:] > 5) + 1:
        dragged = view(made.ranges + 0.04 * (surface == k))
        wrong = dragged.descend(pose[None])[0][0]
        error = np.abs(se2.between(wrong, pose))
        beyond["level"] += (error > protection.protection_level(dragged, wrong, COVARIANCE, 0.0)).any()
        beyond["covariance"] += (error > 3.89 * np.sqrt(np.diag(COVARIANCE))).any()
    assert beyond["level"] < beyond["covariance"] / 2, beyond
