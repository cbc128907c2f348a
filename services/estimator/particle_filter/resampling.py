"""Low-variance and KLD resampling (Fox 2003)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from common.geometry.se2 import Array

    Indices = npt.NDArray[np.int64]

BIN = (0.5, 0.5, np.pi / 18)  # m, m, rad: nav2's kd-tree cells
HEADING_BINS = 36
OFFSET = 1 << 20  # so many bins either side of the origin: 500 km


def tempered(log_weights: Array, share: float) -> Array:
    """(N,) weights exp(beta log_weights), normalised: beta = 1, or so small that ``share`` of them count.

    What counts is the effective sample size 1 / sum of squares (Del Moral, Doucet, Jasra 2012). While particles are
    sparse, the right place may have none near enough to beat a lucky one in a place that looks alike.
    """
    log = log_weights - log_weights.max()

    def weigh(beta: float) -> Array:
        weights = np.exp(beta * log)
        return np.asarray(weights / weights.sum())

    low, high = 0.0, 1.0
    if share <= 0 or 1 / np.sum(weigh(1.0) ** 2) >= share * len(log):
        return weigh(1.0)
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if 1 / np.sum(weigh(middle) ** 2) >= share * len(log) else (low, middle)
    return weigh(low)


def low_variance(weights: Array, count: int, rng: np.random.Generator) -> Indices:
    """(count,) indices, each i about count * weights[i] times, never off by one or more; weights (N,) sum to 1."""
    comb = (rng.random() + np.arange(count)) / count
    cumulative = np.cumsum(weights)
    # Rounding may leave the sum below 1: the last particle with weight takes what is left.
    last = int(np.flatnonzero(weights)[-1])
    return np.minimum(np.searchsorted(cumulative / cumulative[-1], comb, side="right"), last).astype(np.int64)


def bins(poses: Array) -> Indices:
    """(N,) numbers of the 0.5 m x 0.5 m x 10 deg bins that poses (N, 3) fall into."""
    x = np.floor(poses[:, 0] / BIN[0]).astype(np.int64) + OFFSET
    y = np.floor(poses[:, 1] / BIN[1]).astype(np.int64) + OFFSET
    yaw = np.floor(poses[:, 2] / BIN[2]).astype(np.int64) % HEADING_BINS
    return np.asarray((x * (2 * OFFSET) + y) * HEADING_BINS + yaw)


def kld_bound(occupied: npt.ArrayLike, err: float, z: float) -> Array:
    """Particles so that the sampled belief is within ``err`` nats of the true one, for k ``occupied`` bins.

    (k - 1) / (2 err) (1 - 2 / (9 (k - 1)) + sqrt(2 / (9 (k - 1))) z)^3, z the standard normal's quantile of the
    confidence wanted. One bin needs one particle: nav2 takes the maximum there, which only costs time.
    """
    k = np.asarray(occupied, float)
    c = 2 / (9 * np.maximum(k - 1, 1e-9))
    return np.where(k > 1, np.ceil((k - 1) / (2 * err) * (1 - c + np.sqrt(c) * z) ** 3), 1.0)


def adaptive_count(drawn_bins: Indices, err: float, z: float, least: int, most: int) -> int:
    """How many of draws in random order, whose bins are ``drawn_bins`` (M,), suffice; between least and most."""
    first = np.zeros(len(drawn_bins), bool)
    first[np.unique(drawn_bins, return_index=True)[1]] = True
    enough = np.arange(1, len(first) + 1) >= kld_bound(np.cumsum(first), err, z)
    enough[: least - 1] = False  # the first draws meet few bins, that does not make them enough
    # Where all of them do not suffice, what their bins ask for.
    needed = np.argmax(enough) + 1 if enough.any() else kld_bound(first.sum(), err, z)
    return int(np.clip(needed, least, most))
