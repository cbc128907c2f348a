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

    Singles = npt.NDArray[np.float32]

SHORT_MISFIT_FACTOR = 0.6  # a beam shorter than expected counts less than a longer one, because it may be blocked
UNKNOWN_MISFIT = 0.4  # of a beam for which the model has no prediction

# The same for whole steps of range: capped absolute errors, which fit into a byte and into vector registers.
LONG_MISFIT_STEPS, SHORT_MISFIT_STEPS, UNKNOWN_MISFIT_STEPS = 6, 4, 2
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
    attention: Array,
    energy: Array,
    gradient: Array,
    matrices: Array,
) -> None:
    """Sums -ln p(o | pose) and its derivatives over the beams; see `services.estimator.precise.likelihood`.

    Adds to energy (N,), to gradient (N, 3), and to matrices (N, 3, 3, 3): the curvature and the covariances of the
    gradient caused by the scanner's noise and by the model's error. ``attention`` (N, B) scales the derivatives of each
    beam; it may be empty, for 1.
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
            share = attention[k, b] if attention.size else 1.0
            weight = share * inlier / variance
            slope = weight * e - share * early / (max(g, 1e-3) * density)  # d ln p / dg
            # The variance grows with g, too.
            slope += share * inlier * relative * relative * g * (e * e / variance - 1.0) / variance
            for i in range(3):
                gradient[k, i] += slope * jacobian[k, b, i]
                for j in range(3):
                    outer = jacobian[k, b, i] * jacobian[k, b, j] * weight
                    matrices[k, 0, i, j] += outer
                    matrices[k, 1, i, j] += outer * noise / variance
                    matrices[k, 2, i, j] += outer * model / variance


@jit
def rank_places(
    panoramas: Singles,
    bins: npt.NDArray[np.int_],
    measured: Singles,
    tolerance: float,
    range_max: float,
    costs: Singles,
) -> None:
    """Fills costs (S, H) of every place and heading with the mean over beams of e² / (e² + tolerance²).

    ``panoramas`` (S, A) m are ranges all around each place, ``bins`` (B,) the direction of each beam among those A, and
    ``measured`` (B,) m the scan. Beams shorter than expected count less, see `SHORT_MISFIT_FACTOR`.
    """
    size, headings = panoramas.shape[1], costs.shape[1]
    for s in range(panoramas.shape[0]):
        for h in range(headings):
            shift = h * size // headings
            total, used = 0.0, 0
            for b in range(bins.shape[0]):
                o = measured[b]
                if o == -np.inf or np.isnan(o):
                    continue
                g = panoramas[s, (bins[b] + shift) % size]
                if np.isnan(g):
                    total, used = total + UNKNOWN_MISFIT, used + 1
                    continue
                e = min(o, range_max) - min(g, range_max)
                misfit = e * e / (e * e + tolerance * tolerance)
                total += misfit if e > 0.0 else SHORT_MISFIT_FACTOR * misfit
                used += 1
            costs[s, h] = total / max(used, 1)


@jit
def rank_roughly(
    panoramas: npt.NDArray[np.uint16],
    bins: npt.NDArray[np.int64],
    measured: npt.NDArray[np.uint16],
    range_max: int,
    shift: int,
    costs: npt.NDArray[np.uint16],
) -> None:
    """Fills costs (S,) of every place with the least sum of capped errors over beams, at any of H headings.

    ``panoramas`` (S, P, H) are ranges in the directions P h + p, 0 if unknown, ``bins`` (B,) the direction of each
    beam, and ``measured`` (B,) the scan. All ranges are in the same steps, limited to ``range_max``, and compared
    without their lowest ``shift`` bits. Beams shorter than expected count less, see `SHORT_MISFIT_FACTOR`.
    """
    phases, headings = panoramas.shape[1:]
    lanes = (headings + LANES - 1) // LANES * LANES
    around = np.zeros((phases, headings + lanes), np.uint8)  # a byte for each direction, more than once around
    sums = np.empty(lanes, np.uint16)
    most, long, short, unknown = (
        np.uint16(min(range_max >> shift, 255)),
        np.uint8(LONG_MISFIT_STEPS),
        np.uint8(SHORT_MISFIT_STEPS),
        np.uint8(UNKNOWN_MISFIT_STEPS),
    )
    for s in range(panoramas.shape[0]):
        for p in range(phases):
            for h in range(headings):
                steps = panoramas[s, p, h]
                around[p, h] = np.uint8(max(min(np.uint16(steps >> shift), most), min(steps, np.uint16(1))))
            around[p, headings : 2 * headings] = around[p, :headings]
        sums[:] = 0
        for b in range(bins.shape[0]):
            o = np.uint8(min(np.uint16(measured[b] >> shift), most))
            first = bins[b] // phases
            expected = around[bins[b] % phases, first : first + lanes]  # a slice, so that the loop is vectorised
            for h in range(lanes):
                g = expected[h]
                higher = max(o, g)
                misfit = min(np.uint8(higher - g), long) + min(np.uint8(higher - o), short)
                sums[h] = np.uint16(sums[h] + (misfit if g > 0 else unknown))
        costs[s] = sums[:headings].min()
