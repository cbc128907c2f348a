"""Sums over the beams of a scan, compiled by numba: its likelihood, and its misfit at many places.

numba keeps the compiled code beside this file, or in NUMBA_CACHE_DIR, so it is compiled once per machine.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array

# Largest errors that count in a search, in steps of `global_seeds.RANGE_STEP_M`.
LONG_MISFIT_STEPS, SHORT_MISFIT_STEPS = 10, 6  # a shorter beam counts less, because it may be blocked
REMOVED_MISFIT_STEPS = 2  # of a beam that ends at the next surface behind the expected one
BEHIND_MISFIT_STEPS = LONG_MISFIT_STEPS - REMOVED_MISFIT_STEPS
UNKNOWN_MISFIT_STEPS = 4  # of a beam for which the model has no prediction
LANES = 128  # of a vector register for bytes; headings are padded to a multiple

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@jit
def accumulate(
    measured: Array,
    expected: Array,
    jacobian: Array,
    scale: Array,
    sigma: float,
    relative: float,
    extra_sigma: float,
    short: float,
    random: float,
    range_max: float,
    unseen: float,
    weights: Array,
    energy: Array,
    gradient: Array,
    matrices: Array,
) -> None:
    """Sums -ln p(o | pose) and its derivatives over the beams; see `services.estimator.precise.likelihood`.

    Adds to energy (N,), to gradient (N, 3), and to matrices (N, 3, 3, 3): the curvature and the covariances of the
    gradient caused by the scanner's noise and by the model's error. ``weights`` (N, B) scale the derivatives of each
    beam; the array may be empty, for 1.
    """
    flat = random / range_max
    for k in range(expected.shape[0]):
        for b in range(measured.shape[0]):
            o, g = measured[b], expected[k, b]
            if o == -np.inf or np.isnan(o):
                continue
            if scale[k, b] == np.inf:  # unknown beyond g: all ranges beyond are equally likely
                if o < g:
                    energy[k] -= math.log((1.0 - unseen) * (flat + short / max(g, 1e-3)))
                elif o < np.inf:
                    energy[k] -= math.log((1.0 - unseen) * (flat + (1.0 - short - random) / max(range_max - g, 1.0)))
                else:
                    energy[k] -= math.log(unseen)
                continue
            if o == np.inf:
                energy[k] -= math.log(unseen if g < range_max else 1.0 - unseen)
                continue
            if g >= range_max:
                energy[k] -= math.log(unseen / range_max)
                continue
            noise, model = sigma * sigma + relative * relative * g * g, scale[k, b] * scale[k, b]
            variance = noise + model + extra_sigma * extra_sigma
            e = o - g
            core = (1.0 - short - random) * math.exp(-0.5 * e * e / variance) / math.sqrt(2 * math.pi * variance)
            early = short / max(g, 1e-3) if o < g else 0.0
            density = core + flat + early
            inlier = core / density
            energy[k] -= math.log(density * (1.0 - unseen))
            beam_weight = weights[k, b] if weights.size else 1.0
            information = beam_weight * inlier / variance
            slope = information * e - beam_weight * early / (max(g, 1e-3) * density)  # d ln p / dg
            # The variance grows with g, too.
            slope += beam_weight * inlier * relative * relative * g * (e * e / variance - 1.0) / variance
            for i in range(3):
                gradient[k, i] += slope * jacobian[k, b, i]
                for j in range(3):
                    outer = jacobian[k, b, i] * jacobian[k, b, j] * information
                    matrices[k, 0, i, j] += outer
                    matrices[k, 1, i, j] += outer * noise / variance
                    matrices[k, 2, i, j] += outer * model / variance


@jit
def rank_places(
    panoramas: npt.NDArray[np.uint64],
    bins: npt.NDArray[np.int64],
    measured: npt.NDArray[np.uint8],
    most: int,
    least: npt.NDArray[np.uint16],
    costs: npt.NDArray[np.uint16],
) -> None:
    """Fills costs (S, H) of every place and heading with the sum of capped absolute errors over beams.

    ``least`` (S,) gets the smallest cost of each place; costs may be empty (0, H) if no others are needed.
    ``panoramas`` (S, 2, H / 8), 8 directions in a word, are ranges to the first surface (0 if unknown) and to the next
    one behind it, where a beam ends if the first was removed. ``bins`` (B,) is the direction of each beam in the scan
    ``measured`` (B,). All ranges are in the same steps, limited to ``most``.
    """
    words = panoramas.shape[2]
    headings = panoramas.itemsize * words
    lanes = (headings + LANES - 1) // LANES * LANES
    # All directions, more than once around, so that the headings of a beam are one slice. Copied in words, because a
    # loop over bytes takes as long as the sums.
    around_words = np.zeros((2, 2 * words + lanes // panoramas.itemsize), np.uint64)
    around = around_words.view(np.uint8)
    sums = np.empty(lanes, np.uint16)
    long, short, removed, beyond, unknown, limit = (
        np.uint8(LONG_MISFIT_STEPS),
        np.uint8(SHORT_MISFIT_STEPS),
        np.uint8(REMOVED_MISFIT_STEPS),
        np.uint8(BEHIND_MISFIT_STEPS),
        np.uint8(UNKNOWN_MISFIT_STEPS),
        np.uint8(most),
    )
    for s in range(panoramas.shape[0]):
        for layer in range(2):
            for w in range(words):
                around_words[layer, w] = around_words[layer, w + words] = panoramas[s, layer, w]
        sums[:] = 0
        for b in range(bins.shape[0]):
            o, first = min(measured[b], limit), bins[b]
            # Slices, so that the loop is vectorised.
            surface, behind = around[0, first : first + lanes], around[1, first : first + lanes]
            for h in range(lanes):
                g, next_g = min(surface[h], limit), min(behind[h], limit)
                past = min(np.uint8(max(o, next_g) - min(o, next_g)), beyond)
                late = min(np.uint8(max(o, g) - g), long, np.uint8(removed + past))
                misfit = late if o > g else min(np.uint8(g - min(o, g)), short)
                sums[h] = np.uint16(sums[h] + (misfit if g > 0 else unknown))
        least[s] = sums[:headings].min()
        if costs.size:
            costs[s] = sums[:headings]
