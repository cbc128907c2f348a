"""Scores of hand-made sequences of estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lab.integrity.report import reliability_diagram, table
from lab.integrity.scoring import Estimates, reliability, score_case, score_trial, share_of_scans
from lab.statistics import MAX_NEES
from services.estimator.shared.interface import Hypothesis, Posterior

TRUTHS = np.tile([1.0, 2.0, np.pi - 0.01], (6, 1))
ERRORS = np.array([[0, 0, 0], [0.1, 0, 0.02], [0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.1], [0, 0, 0]])
STATES = ("tracking", "tracking", "tracking", "tracking", "lost", "localising")


def posterior(pose, state, **fields):
    hypotheses = (Hypothesis(pose, np.diag([0.01, 0.01, 0.0004]), 1.0),)
    return Posterior(state, hypotheses, 0.0, 0.0, np.zeros(3), np.eye(3), np.zeros(1), **fields)


@pytest.fixture
def scans():
    posteriors = [posterior(pose, state) for pose, state in zip(TRUTHS + ERRORS, STATES, strict=True)]
    return Estimates.of(posteriors, TRUTHS, [0.001] * 6)


def test_correct_and_wrong(scans):
    assert scans.correct.tolist() == [True, True, False, False, False, True]
    assert scans.wrong.tolist() == [False, False, True, True, False, False]
    assert scans.nees[1] == pytest.approx([1.0, 2.0])


def test_nees_of_a_covariance_that_claims_certainty():
    certain = Hypothesis(TRUTHS[0] + ERRORS[1], np.diag([0.01, 0.0, 0.0004]), 1.0)
    made = Posterior("tracking", (certain,), 0.0, 0.0, np.zeros(3), np.eye(3), np.zeros(1))
    assert Estimates.of([made], TRUTHS[:1], [0.001]).nees.tolist() == [[MAX_NEES, MAX_NEES]]


def test_trial(scans):
    scores = score_trial(scans, 10.0, [1, 2], separate=False)
    counts = {"scans": 6, "in_map": 6, "tracking": 4, "correct": 3, "wrong": 2, "kidnapped": 2, "recovered": 1}
    assert scores == {**counts, "longest_wrong_s": 0.2}
    assert score_trial(scans, 10.0, [], separate=True)["longest_wrong_s"] == 0.1


def test_case(scans):
    trial = {"seed": 1, **score_trial(scans, 1.0, [], separate=False)}
    row = score_case([trial, trial], Estimates.joined([scans, scans]))
    assert row["wrong"] == {"count": 4, "of": 8, "interval_95": None}
    assert row["trials_wrong"] == {"count": 2, "of": 2, "interval_95": None}  # in one building
    other = score_case([trial, trial | {"seed": 2}], Estimates.joined([scans, scans]))
    assert other["trials_wrong"]["interval_95"] == pytest.approx([0.342, 1.0], abs=1e-3)
    assert row["trials_wrong_longer"] == 2
    assert row["nees_xy"] == pytest.approx((0 + 1 + 9 + 9) / 4)
    assert row["error_median_m"] == 0
    assert row["recovered"] is None
    assert "| 50; 2.0 s; 2 of 2 |" in table({"precise": {"unchanged": row}})


def test_interval_of_a_share_is_by_building():
    """All wrong scans are in one of twenty buildings, so the interval reaches from none to several times the share."""
    trials = [{"seed": seed, "wrong": 100 * (seed == 0), "tracking": 1000} for seed in range(20)]
    wrong = share_of_scans(trials, "wrong", "tracking")
    assert (wrong["count"], wrong["of"]) == (100, 20000)
    assert wrong["interval_95"] == pytest.approx([0, 0.015], abs=0.0051)
    assert share_of_scans(trials[1:], "wrong", "tracking")["interval_95"] is None


def test_robot_outside_the_map(scans):
    away = replace(scans, error=np.full((6, 3), np.nan), nees=np.full((6, 2), np.nan))
    row = score_case([{"seed": 1, **score_trial(away, 1.0, [], separate=False)}], away)
    assert row["correct"] is None
    assert row["wrong"]["count"] == row["wrong"]["of"] == 4


def test_reliability_bins():
    probability = np.array([0.95, 0.95, 0.95, 0.95, 1.0, 1.0, np.nan])
    correct = np.array([True, True, True, False, True, True, False])
    bins = reliability(probability, correct)
    assert [(each["reported"], each["correct"]["count"], each["correct"]["of"]) for each in bins] == [
        (pytest.approx(0.95), 3, 4),
        (1.0, 2, 2),
    ]


def test_protection_in_base_link():
    facing_left = np.array([0.0, 0.0, np.pi / 2])
    protection = np.array([0.1, 0.01, 0.1])
    made = posterior(np.array([0.0, 0.05, np.pi / 2]), "tracking", probability=0.99, protection=protection)
    scans = Estimates.of([made], facing_left[None], [0.001])
    assert scans.excess[0] == pytest.approx([0.5, 0.0, 0.0])
    row = score_case([{"seed": 1, **score_trial(scans, 1.0, [], separate=False)}], scans)
    assert row["beyond_protection"] == [0.0, 0.0, 0.0]
    assert reliability_diagram({"precise": {"all": row}}) is not None


def test_scans_file(scans, tmp_path):
    scans.save(tmp_path / "trial.npz")
    assert Estimates.load(tmp_path / "trial.npz").error == pytest.approx(scans.error)
