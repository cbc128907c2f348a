"""Compares what an estimator reported with the truth: scores of scans, of trials and of cases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from common.geometry.se2 import Array
from lab.accuracy.tasks import FOUND_DISTANCE, FOUND_YAW
from lab.statistics import bootstrap_interval, longest_duration, root_mean_square, squared_mahalanobis, wilson_interval
from services.estimator.shared.interface import Posterior

Mask = npt.NDArray[np.bool_]

RECOVERY_SCANS = 20  # after a kidnapping, until the robot must be found
MAX_WRONG_S = 1.0  # a longer wrong stretch fails a trial
MIN_BUILDINGS = 10  # for an interval of a share of scans; fewer say too little about how buildings differ
# Edges of the bins of reported probability; the last bins matter for safety.
PROBABILITY_EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.99, 0.999, 0.9999, 1.0)


@dataclass(frozen=True)
class Estimates:
    """What an estimator reported for the N scans of a trial, compared with the truth."""

    error: Array  # (N, 3) m, m, rad in map; NaN where the robot is not in the map
    tracking: Mask  # (N,) whether the state was `tracking`
    nees: Array  # (N, 2) NEES of x and y, and of x, y and yaw; NaN without a covariance
    probability: Array  # (N,) that the pose is correct, as reported; NaN if not reported
    excess: Array  # (N, 3) |error| in base_link divided by the protection level; NaN if not reported
    update_s: Array  # (N,) processor time

    @classmethod
    def of(cls, posteriors: Sequence[Posterior], truths: Array, update_s: Sequence[float]) -> Estimates:
        """Compares posteriors with true poses (N, 3)."""
        error = np.array([posterior.pose for posterior in posteriors]) - truths
        error[:, 2] = se2.wrap(error[:, 2])
        return cls(
            error,
            np.array([posterior.state == "tracking" for posterior in posteriors]),
            np.array([_nees(e, posterior.covariance) for e, posterior in zip(error, posteriors, strict=True)]),
            np.array([_or_nan(posterior.probability) for posterior in posteriors]),
            np.array([_excess(e, posterior) for e, posterior in zip(error, posteriors, strict=True)]),
            np.array(update_s),
        )

    @classmethod
    def joined(cls, parts: Sequence[Estimates]) -> Estimates:
        """The scans of several trials."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    @classmethod
    def load(cls, path: Path) -> Estimates:
        """Reads the file of a trial."""
        with np.load(path) as stored:
            return cls(**{f.name: stored[f.name] for f in fields(cls)})

    def save(self, path: Path) -> None:
        """Writes the file of a trial."""
        np.savez_compressed(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @property
    def correct(self) -> Mask:
        """(N,) whether the error is below 0.2 m and 5 degrees."""
        near = np.hypot(self.error[:, 0], self.error[:, 1]) < FOUND_DISTANCE
        return np.asarray(near & (np.abs(self.error[:, 2]) < FOUND_YAW))

    @property
    def wrong(self) -> Mask:
        """(N,) whether the state was `tracking` at a pose that is not correct."""
        return self.tracking & ~self.correct


def _nees(error: Array, covariance: Array | None) -> list[float]:
    """NEES of x and y, and of x, y and yaw."""
    if covariance is None or not np.isfinite(error).all():
        return [np.nan, np.nan]
    return [squared_mahalanobis(error[:n], covariance[:n, :n]) for n in (2, 3)]


def _excess(error: Array, posterior: Posterior) -> Array:
    if posterior.protection is None:
        return np.full(3, np.nan)
    in_base = np.array([*se2.rotate(-float(posterior.pose[2]), error[:2]), error[2]])
    return np.asarray(np.abs(in_base) / posterior.protection)


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def score_trial(scans: Estimates, rate: float, kidnappings: Sequence[int], *, separate: bool) -> dict[str, Any]:
    """Scores of one trial whose scans come at ``rate`` Hz; ``separate`` scans are not one stretch of time."""
    right = scans.tracking & scans.correct
    recovered = [bool(right[first : first + RECOVERY_SCANS].any()) for first in kidnappings]
    longest = longest_duration(scans.wrong, np.full(len(scans.wrong), 1 / rate))
    return {
        "scans": len(scans.tracking),
        "tracking": int(scans.tracking.sum()),
        "in_map": int(np.isfinite(scans.error[:, 0]).sum()),
        "correct": int(scans.correct.sum()),
        "wrong": int(scans.wrong.sum()),
        "longest_wrong_s": min(longest, 1 / rate) if separate else longest,
        "kidnapped": len(recovered),
        "recovered": sum(recovered),
    }


def score_case(trials: Sequence[dict[str, Any]], scans: Estimates) -> dict[str, Any]:
    """Scores of a case, from those of its trials and from all their scans, with 95 % intervals.

    Scans of one building depend on each other, so the intervals of shares of scans are by building. Shares of drives
    and of kidnappings have one only if each is in a building of its own.
    """
    longest = [trial["longest_wrong_s"] for trial in trials]
    distance = np.hypot(scans.error[:, 0], scans.error[:, 1])[scans.correct]
    buildings = [trial["seed"] for trial in trials]
    of_kidnappings = [trial["seed"] for trial in trials for _ in range(trial["kidnapped"])]
    return {
        "trials": len(trials),
        "scans": sum(trial["scans"] for trial in trials),
        "tracking": share_of_scans(trials, "tracking", "scans"),
        "wrong": share_of_scans(trials, "wrong", "tracking"),
        "longest_wrong_s": max(longest),
        "trials_wrong": share(sum(trial["wrong"] > 0 for trial in trials), len(trials), independent=_differ(buildings)),
        "trials_wrong_longer": sum(value > MAX_WRONG_S for value in longest),
        "correct": share_of_scans(trials, "correct", "in_map"),
        "nees_xy": _mean(scans.nees[scans.tracking, 0]),
        "nees_xy_median": _median(scans.nees[scans.tracking, 0]),
        "nees": _mean(scans.nees[scans.tracking, 1]),
        "error_median_m": _median(distance),
        "error_rms_m": root_mean_square(distance) if len(distance) else None,
        "recovered": share(
            sum(trial["recovered"] for trial in trials), len(of_kidnappings), independent=_differ(of_kidnappings)
        ),
        "beyond_protection": [_mean((axis > 1)[np.isfinite(axis)]) for axis in scans.excess.T],
        "reliability": reliability(scans.probability, scans.correct),
        "update_ms": [1e3 * float(np.quantile(scans.update_s, q)) for q in (0.5, 0.95, 1.0)],
    }


def share_of_scans(trials: Sequence[dict[str, Any]], name: str, of_name: str) -> dict[str, Any] | None:
    """``count``, ``of`` and 95 % interval of a share of the scans of all trials; None if ``of`` is 0.

    The interval is a bootstrap by building. It is None for fewer than `MIN_BUILDINGS`, or if all or none are counted,
    because resampling cannot show how rare the others are.
    """
    buildings = dict.fromkeys(trial["seed"] for trial in trials)
    counts = [
        np.array([(trial[name], trial[of_name]) for trial in trials if trial["seed"] == building])
        for building in buildings
    ]
    count, of = map(int, np.concatenate(counts).sum(axis=0))
    if not of:
        return None
    known = len(buildings) >= MIN_BUILDINGS and 0 < count < of
    return {"count": count, "of": of, "interval_95": bootstrap_interval(counts, _ratio_of_sums) if known else None}


def _ratio_of_sums(counts: Array) -> float:
    count, of = counts.sum(axis=0)
    return float(count / of) if of else 0.0


def share(count: int, of: int, *, independent: bool = True) -> dict[str, Any] | None:
    """``count``, ``of`` and, for independent events, Wilson's 95 % interval; None if ``of`` is 0."""
    if not of:
        return None
    return {"count": count, "of": of, "interval_95": wilson_interval(count, of) if independent else None}


def _differ(buildings: Sequence[int]) -> bool:
    return len(set(buildings)) == len(buildings)


def reliability(probability: Array, correct: Mask) -> list[dict[str, Any]]:
    """For each bin of reported probability that has scans: the mean of it, and how many of the scans were correct.

    The intervals are as if the scans were independent.
    """
    reported = np.isfinite(probability)
    probability, correct = probability[reported], correct[reported]
    index = np.clip(np.searchsorted(PROBABILITY_EDGES, probability, side="right") - 1, 0, len(PROBABILITY_EDGES) - 2)
    return [
        {"reported": float(probability[here].mean()), "correct": share(int(correct[here].sum()), int(here.sum()))}
        for here in (index == k for k in range(len(PROBABILITY_EDGES) - 1))
        if here.any()
    ]


def _mean(values: Array | Mask) -> float | None:
    known = np.asarray(values, float)[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
