"""Low-variance and KLD resampling (Fox 2003)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from common.geometry.se2 import Array

    Indices = npt.NDArray[np.int64]

BIN_SIZE = (0.5, 0.5, np.pi / 18)  # m, m, rad, as the cells of nav2's kd-tree
HEADING_BINS = 36
BIN_OFFSET = 1 << 20  # bins to either side of the origin, which are 500 km


def tempered(log_weights: Array, share: float) -> Array:
    """Normalised weights exp(beta log_weights) (N,), with the largest beta <= 1 that keeps enough effective particles.

    The effective sample size, 1 / sum of squared weights, is at least ``share`` of the particles (Del Moral, Doucet,
    Jasra 2012). This is needed while particles are sparse: the nearest particle to the true pose may then fit worse
    than one that is, by chance, well placed in a similar room.
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
    """Draws indices (count,), index i about count * weights[i] times, rounded up or down. Weights (N,) sum to 1."""
    comb = (rng.random() + np.arange(count)) / count
    cumulative = np.cumsum(weights)
    # Rounding may leave the sum below 1; the last particle with weight gets the rest.
    last = int(np.flatnonzero(weights)[-1])
    return np.minimum(np.searchsorted(cumulative / cumulative[-1], comb, side="right"), last).astype(np.int64)


def bins(poses: Array) -> Indices:
    """Numbers (N,) of the 0.5 m x 0.5 m x 10 deg bins of poses (N, 3)."""
    x = np.floor(poses[:, 0] / BIN_SIZE[0]).astype(np.int64) + BIN_OFFSET
    y = np.floor(poses[:, 1] / BIN_SIZE[1]).astype(np.int64) + BIN_OFFSET
    yaw = np.floor(poses[:, 2] / BIN_SIZE[2]).astype(np.int64) % HEADING_BINS
    return np.asarray((x * (2 * BIN_OFFSET) + y) * HEADING_BINS + yaw)


def kld_bound(occupied: npt.ArrayLike, err: float, z: float) -> Array:
    """Number of particles with which a belief in k ``occupied`` bins is sampled to within ``err`` nats.

    It is (k - 1) / (2 err) (1 - 2 / (9 (k - 1)) + sqrt(2 / (9 (k - 1))) z)^3, with z the quantile of the standard
    normal for the desired confidence. One bin needs one particle; nav2 takes the maximum number there, which only costs
    time.
    """
    k = np.asarray(occupied, float)
    c = 2 / (9 * np.maximum(k - 1, 1e-9))
    return np.where(k > 1, np.ceil((k - 1) / (2 * err) * (1 - c + np.sqrt(c) * z) ** 3), 1.0)


def adaptive_count(drawn_bins: Indices, err: float, z: float, min_count: int, max_count: int) -> int:
    """Number of particles that suffice, given the bins (M,) of draws in random order; from min_count to max_count."""
    first = np.zeros(len(drawn_bins), bool)
    first[np.unique(drawn_bins, return_index=True)[1]] = True
    enough = np.arange(1, len(first) + 1) >= kld_bound(np.cumsum(first), err, z)
    enough[: min_count - 1] = False  # the first few draws always occupy few bins
    # If all draws together do not suffice, use the bound for their bins.
    needed = np.argmax(enough) + 1 if enough.any() else kld_bound(first.sum(), err, z)
    return int(np.clip(needed, min_count, max_count))
