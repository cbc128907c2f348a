"""Splits a scan into the surfaces that it shows, and predicts each range from its neighbours on the same surface.

A surface that the map lacks is as smooth as one in the map, so only its first beam is improbable. A new cupboard is
therefore one improbable event, however many beams end at it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Likelihood

# Values without a source are guesses.
MAX_SIGMAS = 4.0  # at a range farther from its prediction, another surface starts
CORNER_SIGMAS = 2.5  # a range farther from its prediction may lie behind a corner, where the direction is unknown again
CORNER_PROBABILITY = 0.1  # of a corner there
MAX_SLOPE = 2.0  # standard deviation of dr / (r d angle) where a surface begins
CURVATURE = 0.2  # standard deviation of the change of slope per radian of the scan, relative to 1 / r
JUMP_M = 0.2  # standard deviation of the jump of the range between two surfaces, for half of the jumps
FAR_M = 10.0  # the ranges after the other half are spread over this distance
NO_RETURN = 0.05  # probability that a surface that starts returns no beams
SWITCHES_PER_RAD = 1.0  # along a scan, from one object to another, although both look like one surface
MIN_BEAMS = 3  # on a surface; fewer are often dust, or mixed pixels
OUTLIER = 0.01  # probability that a single beam has an arbitrary range
EDGE_M = 0.02  # an edge of the map may be misplaced by this, or by a cell of a grid if that is larger

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True)
class ScanSurfaces:
    """The surfaces of one scan."""

    log_density: Array  # (B,) nats, ln p(range | the beams before it)
    starts: npt.NDArray[np.bool_]  # (B,) whether another surface starts at this beam
    known_log_density: Array  # (B,) nats, ln p(range) if the surface and its corners had been known
    small: npt.NDArray[np.bool_]  # (B,) beams on surfaces of fewer than `MIN_BEAMS` beams
    edge_tolerance: npt.NDArray[np.int64]  # (B,) beams by which an edge near this one may be misplaced; 0 elsewhere
    switch_probability: float  # that the next beam on the same surface meets another object

    @classmethod
    def from_scan(
        cls, ranges: Array, angles: Array, likelihood: Likelihood, edge_error: float = EDGE_M
    ) -> ScanSurfaces:
        """Splits a scan (B,) m along ``angles`` (B,) rad.

        An edge of the map may be misplaced by ``edge_error`` m, and by one beam more.
        """
        count = len(ranges)
        log_density, starts, known_log_density = np.zeros(count), np.zeros(count, np.bool_), np.zeros(count)
        _split(ranges, angles, likelihood.sigma, likelihood.relative, log_density, starts, known_log_density)
        increment = abs(float(angles[-1] - angles[0])) / max(1, count - 1)
        surface = np.cumsum(starts)
        measured = ranges > -np.inf  # not NaN either
        small = np.bincount(surface, measured)[surface] < MIN_BEAMS if count else starts
        edge_tolerance = np.zeros(count, np.int64)
        _mark_edges(ranges, starts, increment, edge_error, edge_tolerance)
        switch_probability = min(0.5, SWITCHES_PER_RAD * increment)
        return cls(log_density, starts, known_log_density, small, edge_tolerance, switch_probability)


@jit
def _mark_edges(
    ranges: Array,
    starts: npt.NDArray[np.bool_],
    increment: float,
    edge_error: float,
    edge_tolerance: npt.NDArray[np.int64],
) -> None:
    """Fills ``edge_tolerance`` of `ScanSurfaces`."""
    last = -1
    for b in range(ranges.shape[0]):
        if np.isnan(ranges[b]) or ranges[b] == -np.inf:
            continue
        if starts[b] and last >= 0:
            near = min(ranges[b], ranges[last])  # the edge belongs to the nearer of the two surfaces
            reach = 1 + int(edge_error / (near * increment))
            for at in range(max(0, last + 1 - reach), min(ranges.shape[0], b + reach)):
                edge_tolerance[at] = max(edge_tolerance[at], reach)
        last = b


@jit
def _continues(r: float, turn: float, u: float, du: float, variance: float) -> bool:
    """Whether the next range r (m) lies on the surface with u = 1 / r and its derivative at the beam before."""
    error = 1 / r - math.cos(turn) * u - math.sin(turn) * du
    return error * error < MAX_SIGMAS**2 * variance


@jit
def _split(
    ranges: Array,
    angles: Array,
    sigma: float,
    relative: float,
    log_density: Array,
    starts: npt.NDArray[np.bool_],
    known_log_density: Array,
) -> None:
    """Fills ``log_density``, ``starts`` and ``known_log_density`` of `ScanSurfaces`.

    A Kalman filter estimates u = 1 / r and its derivative u' by the angle; p is their covariance, a the predicted one.
    Along a straight wall u'' = -u exactly.
    """
    u, du, p00, p01, p11 = 0.0, 0.0, 0.0, 0.0, 0.0
    last, returned = -1, False
    for b in range(ranges.shape[0]):
        r = ranges[b]
        if np.isnan(r) or r == -np.inf:
            continue
        if r == np.inf:
            starts[b] = returned or last < 0
            log_density[b] = math.log(NO_RETURN if starts[b] else 1 - NO_RETURN)
            last, returned = b, False
            continue
        s = math.sqrt(sigma * sigma + relative * relative * r * r)
        m = s / (r * r)  # standard deviation of 1 / r
        peak = 1 / math.sqrt(2 * math.pi * s * s)
        starts[b] = True
        if returned:
            turn = angles[b] - angles[last]
            cos, sin = math.cos(turn), math.sin(turn)
            u, du = cos * u + sin * du, cos * du - sin * u
            a00 = cos * cos * p00 + 2 * cos * sin * p01 + sin * sin * p11
            a01 = (cos * cos - sin * sin) * p01 + cos * sin * (p11 - p00)
            a11 = sin * sin * p00 - 2 * cos * sin * p01 + cos * cos * p11 + (CURVATURE * u) ** 2 * abs(turn)
            variance, error = a00 + m * m, 1 / r - u
            square = error * error / variance
            if u > 1e-3 and square < MAX_SIGMAS**2:
                # The direction of a surface costs nothing, because in a building it is that of other surfaces.
                log_density[b] = math.log((1 - OUTLIER) * math.exp(-0.5 * square) * peak + OUTLIER / FAR_M)
                known_log_density[b] = log_density[b]
                k0, k1 = a00 / variance, a01 / variance
                u, du = u + k0 * error, du + k1 * error
                p00, p01, p11 = (1 - k0) * a00, (1 - k0) * a01, a11 - k1 * a01
                if square > CORNER_SIGMAS**2:
                    p11 += (MAX_SLOPE * u) ** 2
                    log_density[b] += math.log(CORNER_PROBABILITY)
                starts[b] = False
            elif b + 1 < ranges.shape[0] and _continues(ranges[b + 1], angles[b + 1] - angles[b], u, du, variance):
                # A single beam that ends elsewhere, as at dust, is no surface.
                log_density[b] = known_log_density[b] = math.log(OUTLIER / FAR_M)
                starts[b] = False
                p00, p01, p11 = a00, a01, a11
            else:
                wide = JUMP_M * JUMP_M + s * s
                jump = r - 1 / u if u > 1e-3 else np.inf
                near = math.exp(-0.5 * jump * jump / wide) / math.sqrt(2 * math.pi * wide)
                log_density[b] = math.log(0.5 * near + 0.5 / FAR_M)
        else:
            log_density[b] = math.log(1 / FAR_M)
        if starts[b]:
            known_log_density[b] = math.log((1 - OUTLIER) * peak) - 0.5
            u, du = 1 / r, 0.0
            p00, p01, p11 = m * m, 0.0, (MAX_SLOPE * u) ** 2
        last, returned = b, True
