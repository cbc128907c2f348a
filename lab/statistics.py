"""95 % intervals of shares and of errors, errors relative to the stated covariance, and durations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from common.geometry.se2 import Array

RESAMPLES = 1000
MAX_NEES = 1e6  # of a degenerate covariance


def wilson_interval(count: int, of: int) -> list[float]:
    """Wilson's 95 % interval for the probability of an event that happened ``count`` times in ``of`` trials."""
    z2 = 1.96**2
    middle, half = count + z2 / 2, 1.96 * np.sqrt(count * (of - count) / of + z2 / 4)
    return [float(np.clip((middle + side * half) / (of + z2), 0, 1)) for side in (-1, 1)]


def bootstrap_interval(groups: Sequence[Array], statistic: Callable[[Array], float]) -> list[float] | None:
    """95 % interval of a ``statistic`` of values, by resampling whole groups (Efron & Tibshirani 1993, percentiles).

    Values of one group, such as the scans of one drive, depend on each other. Returns None for fewer than two groups.
    """
    groups = [np.asarray(group, float) for group in groups if len(group)]
    if len(groups) < 2:
        return None
    rng = np.random.default_rng(0)
    found = [
        statistic(np.concatenate([groups[k] for k in rng.integers(len(groups), size=len(groups))]))
        for _ in range(RESAMPLES)
    ]
    return [float(bound) for bound in np.quantile(found, (0.025, 0.975))]


def squared_mahalanobis(error: Array, covariance: Array) -> float:
    """Error' covariance^-1 error. Returns `MAX_NEES` if it is larger, or if a direction has no variance.

    Its mean over scans is the NEES, ideally the number of components (Bar-Shalom et al. 2001, section 5.4).
    """
    if np.linalg.eigvalsh(covariance)[0] <= 0:
        return MAX_NEES
    return min(float(error @ np.linalg.solve(covariance, error)), MAX_NEES)


def median(values: Array) -> float:
    """The median of the values."""
    return float(np.median(values))


def root_mean_square(values: Array) -> float:
    """The root of the mean of the squared values."""
    return float(np.sqrt(np.mean(np.square(values))))


def longest_duration(values: npt.NDArray[np.bool_], periods: Array) -> float:
    """Longest uninterrupted time in s for which ``values`` (N,) are true, each for its ``periods`` (N,) s.

    Rounded to microseconds, so that 15 periods of 1/15 s are 1 s.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], values, [False]])))
    times = np.concatenate([[0.0], np.cumsum(periods)])
    return round(float(np.diff(times[edges])[::2].max(initial=0.0)), 6)
