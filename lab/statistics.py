"""95 % intervals of shares and of errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from common.geometry.se2 import Array

RESAMPLES = 1000


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


def median(values: Array) -> float:
    """The median of the values."""
    return float(np.median(values))


def root_mean_square(values: Array) -> float:
    """The root of the mean of the squared values."""
    return float(np.sqrt(np.mean(np.square(values))))
