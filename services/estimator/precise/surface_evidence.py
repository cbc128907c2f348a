"""Evidence of a scan for poses, by surfaces instead of by beams.

Each beam is in one of four states:

- 0, mapped: it ends at the surface that the map shows;
- 1, in front: at something in front of that surface;
- 2, behind: at something behind that surface which the map lacks;
- 3, removed: at the map's next surface, because the first one was removed.

The states are a Markov chain along the scan, since neighbouring beams mostly meet the same surface. Where another
surface starts in the scan, the state does not depend on the one before: a removed chair says nothing about the wall
beside it. The same holds where another surface starts in the map, except for state 1, as a new object may stand in
front of both. The forward algorithm sums over all sequences of states, and the backward algorithm gives the probability
of each state (Rabiner 1989, section III).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

from services.estimator.precise.scan_surfaces import FAR_M, NO_RETURN, OUTLIER

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Likelihood
    from services.estimator.precise.scan_surfaces import ScanSurfaces
    from services.estimator.shared.generative_models import Expected


# Probability of each state (a guess) if a beam does not end at the surface that the map shows; the first is not used.
CHANGED_STATE_PRIOR = np.array([0.0, 0.6, 0.2, 0.2])
COINCIDENCE = 0.3  # probability (a guess) that something new is within `NEAR_SIGMAS` of a surface of the map
NEAR_SIGMAS = 3.0
# If the map's range at the next beam is farther from the straight continuation of the surface, another surface starts.
BORDER_M = 0.1
PLAUSIBLE_SIGMAS = 2.0  # a larger error is penalised, see `_log_density`
MEAN_PENALTY = 0.04  # nats, mean of this penalty for Gaussian errors; it is added back, so that their mean is 0

STATES = 4  # a constant, so that loops over the states are unrolled; array operations would allocate memory
jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True)
class SurfaceEvidence:
    """Evidence of one scan at N poses."""

    by_beam: Array  # (N, B) nats, log likelihood of each beam given those before it; 0 for a beam that was not measured
    explained: Array  # (N,) expected fraction of the beams that end at a surface of the map, the first or the next
    weights: Array  # (N, B) probability that a beam ends at the first surface of the map

    @classmethod
    def from_scan(
        cls,
        ranges: Array,
        range_max: float,
        expected: Expected,
        behind: Array,
        borders: npt.NDArray[np.bool_],
        surfaces: ScanSurfaces,
        likelihood: Likelihood,
        changed_fraction: float,
        extra_sigma: float = 0.0,
    ) -> SurfaceEvidence:
        """Compares a scan (B,) m with the scans that are expected at N poses.

        ``behind`` (N, B) m are the ranges to the map's next surface behind the expected one; ``borders`` (N, B) is true
        where the map shows another surface than at the beam before. ``changed_fraction`` is the fraction of the beams
        that do not end at the map's first surface.
        """
        count = len(expected.ranges)
        by_beam, explained, weights = np.empty(expected.ranges.shape), np.empty(count), np.empty(expected.ranges.shape)
        sigma = math.hypot(likelihood.sigma, extra_sigma)
        prior = changed_fraction * CHANGED_STATE_PRIOR
        prior[0] = 1 - changed_fraction
        _forward_backward(
            ranges,
            expected.ranges,
            behind,
            borders,
            expected.scale,
            sigma,
            likelihood.relative,
            range_max,
            surfaces.log_density,
            surfaces.known_log_density,
            surfaces.starts,
            surfaces.edge_tolerance,
            prior,
            surfaces.switch_probability,
            by_beam,
            explained,
            weights,
        )
        return cls(by_beam, explained, weights)

    @property
    def log_likelihood(self) -> Array:
        """Log likelihood (N,) in nats of all beams."""
        return np.asarray(self.by_beam.sum(axis=1))

    def without(self, skip: npt.NDArray[np.bool_]) -> Array:
        """Log likelihood (N,) in nats of the beams that are not in ``skip`` (B,)."""
        return np.asarray(self.by_beam[:, ~skip].sum(axis=1))

    def first(self, count: int) -> SurfaceEvidence:
        """The evidence at the first ``count`` poses."""
        return SurfaceEvidence(self.by_beam[:count], self.explained[:count], self.weights[:count])


@jit
def _log_density(
    error: float, noise_variance: float, model_variance: float, known_log_density: float, starts_surface: np.bool_
) -> float:
    """Log density of a range that differs by ``error`` m from that of a surface of the map.

    The variances in m² are those of the scanner's and of the map's error. After the first beam on a surface, the beams
    before predict a range better than a map with errors, so its density is ``known_log_density``, reduced if the range
    is too far from the map. The map's error is alike along a surface and would be counted at each beam, so the
    reduction is multiplied by the scanner's fraction of the variance.
    """
    variance = noise_variance + model_variance
    square = error * error / variance
    if starts_surface:
        return math.log((1 - OUTLIER) * math.exp(-0.5 * square) / math.sqrt(2 * math.pi * variance) + OUTLIER / FAR_M)
    excess = 0.5 * max(0.0, square - PLAUSIBLE_SIGMAS**2) - MEAN_PENALTY
    return float(max(known_log_density - excess * noise_variance / variance, math.log(OUTLIER / FAR_M)))


@jit
def _emit(
    r: float,
    surface: float,
    next_surface: float,
    scale: float,
    sigma: float,
    relative: float,
    range_max: float,
    unmapped_log_density: float,
    known_log_density: float,
    starts_surface: np.bool_,
    log_densities: Array,
) -> None:
    """Fills ``log_densities`` (4,) in nats of a range ``r`` in each state.

    ``surface`` and ``next_surface`` are the ranges in m to the map's first and next surface. The log density is
    ``unmapped_log_density`` on a surface that the map lacks, and ``known_log_density`` on one that it shows exactly.
    ``starts_surface`` is true at the first beam on a surface of the scan.
    """
    log_densities[:] = math.log(OUTLIER / FAR_M)
    if scale == np.inf:  # the map is unknown beyond this range
        if r > surface:
            log_densities[:] = unmapped_log_density
        log_densities[1] = unmapped_log_density
        return
    if r == np.inf:
        log_densities[0] = math.log(NO_RETURN if surface < range_max else 1 - NO_RETURN)
        log_densities[1] = log_densities[2] = unmapped_log_density
        log_densities[3] = math.log(NO_RETURN if next_surface < range_max else 1 - NO_RETURN)
        return
    error, near, coincidence = -np.inf, False, 0.0
    model_variance = scale * scale
    if surface < range_max:
        noise_variance = sigma * sigma + relative * relative * surface * surface
        error = r - surface
        near = error * error < NEAR_SIGMAS**2 * (noise_variance + model_variance)
        if near:
            # Counted once per surface as far as the map's error is alike along it, as in `_log_density`.
            coincidence = math.log(COINCIDENCE) * noise_variance / (noise_variance + model_variance)
        log_densities[0] = _log_density(error, noise_variance, model_variance, known_log_density, starts_surface)
    if error < 0 or near:
        log_densities[1] = unmapped_log_density + coincidence
    if error > 0 or near:
        log_densities[2] = unmapped_log_density + coincidence
    if next_surface < range_max:
        noise_variance = sigma * sigma + relative * relative * next_surface * next_surface
        log_densities[3] = _log_density(
            r - next_surface, noise_variance, model_variance, known_log_density, starts_surface
        )


@jit
def _forward_backward(
    ranges: Array,
    expected: Array,
    behind: Array,
    borders: npt.NDArray[np.bool_],
    scale: Array,
    sigma: float,
    relative: float,
    range_max: float,
    unmapped_log_density: Array,
    known_log_density: Array,
    starts: npt.NDArray[np.bool_],
    edge_tolerance: npt.NDArray[np.int64],
    prior: Array,
    switch_probability: float,
    by_beam: Array,
    explained: Array,
    weights: Array,
) -> None:
    """Fills the fields of `SurfaceEvidence` by the forward and the backward algorithm."""
    used = np.flatnonzero(~np.isnan(ranges) & (ranges > -np.inf))
    size = len(used)
    forward, emitted, keep = np.empty((size, STATES)), np.empty((size, STATES)), np.empty((size, STATES))
    for k in range(expected.shape[0]):
        explained[k] = 0.0
        by_beam[k] = 0.0
        weights[k] = 0.0
        for n in range(size):
            b = used[n]
            keep[n] = 0.0 if starts[b] else 1 - switch_probability
            if n > 0 and borders[k, used[n - 1] + 1 : b + 1].any():
                # At the map's next surface the state is drawn again, but a new object may stand in front of both.
                keep[n, 0], keep[n, 2], keep[n, 3] = 0.0, 0.0, 0.0
            map_beam, surface = _nearest_surface(ranges[b], expected[k], b, edge_tolerance[b])
            _emit(
                ranges[b],
                surface,
                behind[k, map_beam],
                scale[k, map_beam],
                sigma,
                relative,
                range_max,
                unmapped_log_density[b],
                known_log_density[b],
                starts[b],
                emitted[n],
            )
            by_beam[k, b] = _step_forward(forward, emitted, prior, keep[n], n)
        backward = np.ones(STATES)
        for n in range(size - 1, -1, -1):
            b = used[n]
            if n < size - 1:
                _step_backward(backward, emitted[n + 1], prior, keep[n + 1])
            if scale[k, b] < np.inf:
                norm = 0.0
                for i in range(STATES):
                    norm += forward[n, i] * backward[i]
                weights[k, b] = forward[n, 0] * backward[0] / norm
                explained[k] += (weights[k, b] + forward[n, 3] * backward[3] / norm) / size


@jit
def _nearest_surface(r: float, expected: Array, b: int, edge_tolerance: int) -> tuple[int, float]:
    """The beam whose surface in the map, continued to beam b, is nearest to the range r (m), and its range at beam b.

    The edge of a surface may be misplaced by ``edge_tolerance`` beams, so the surfaces at as many neighbours are
    continued straight.
    """
    beam, best = b, expected[b]
    for step in (-1, 1):
        for away in range(1, edge_tolerance + 1):
            other = b + step * away
            if not 0 <= other + step < expected.shape[0]:
                break
            u = (away + 1) / expected[other] - away / expected[other + step]  # 1 / range is linear along a wall
            if u > 0 and abs(r - 1 / u) < abs(r - best):
                beam, best = other, 1 / u
    return beam, best


@jit
def _step_forward(forward: Array, emitted: Array, prior: Array, keep: Array, n: int) -> float:
    """Fills the probabilities forward[n] (4,) of the states, given the beams up to the n-th.

    emitted[n] are log densities, and become densities relative to the largest one. ``keep`` (4,) is the probability
    that a beam is in the same state as the one before, instead of one drawn from ``prior``. Returns the log density of
    the n-th beam given those before it.
    """
    top, norm, drawn = emitted[n, 0], 0.0, 1.0
    for i in range(1, STATES):
        top = max(top, emitted[n, i])
    for i in range(STATES):
        if n > 0:
            drawn -= keep[i] * forward[n - 1, i]
    for i in range(STATES):
        emitted[n, i] = math.exp(emitted[n, i] - top)
        forward[n, i] = drawn * prior[i] * emitted[n, i]
        if n > 0:
            forward[n, i] += keep[i] * forward[n - 1, i] * emitted[n, i]
        norm += forward[n, i]
    for i in range(STATES):
        forward[n, i] /= norm
    return float(math.log(norm) + top)


@jit
def _step_backward(backward: Array, emitted: Array, prior: Array, keep: Array) -> None:
    """Updates ``backward`` (4,), the likelihood of the beams that follow for each state, by one more beam."""
    drawn, norm = 0.0, 0.0
    for i in range(STATES):
        backward[i] *= emitted[i]
        drawn += prior[i] * backward[i]
    for i in range(STATES):
        backward[i] = keep[i] * backward[i] + (1 - keep[i]) * drawn
        norm += backward[i]
    for i in range(STATES):
        backward[i] /= norm


def find_borders(expected: Expected, lasers: Array, angles: Array) -> npt.NDArray[np.bool_]:
    """Mask (N, B) of the beams at which the map shows another surface than at the beam before.

    Where two surfaces meet without a gap, as in a corner, there is no border. ``lasers`` (N, 3) are the poses in map,
    ``angles`` (B,) rad the beams in the laser frame.
    """
    borders = np.zeros(expected.ranges.shape, np.bool_)
    _mark_borders(expected.ranges, expected.jacobian, lasers, angles, borders)
    return borders


@jit
def _mark_borders(ranges: Array, jacobian: Array, lasers: Array, angles: Array, borders: npt.NDArray[np.bool_]) -> None:
    """Marks the borders of `find_borders`."""
    for k in range(ranges.shape[0]):
        returned, x, y, nx, ny = False, 0.0, 0.0, 0.0, 0.0  # end point and normal of the beam before
        for b in range(ranges.shape[1]):
            r, direction = ranges[k, b], lasers[k, 2] + angles[b]
            if r == np.inf:
                borders[k, b], returned = returned, False
                continue
            to_x, to_y = r * math.cos(direction) - x, r * math.sin(direction) - y
            before = abs(nx * to_x + ny * to_y)
            length = math.hypot(jacobian[k, b, 0], jacobian[k, b, 1])
            if length > 0:  # 0 where the beam grazes a surface
                nx, ny = jacobian[k, b, 0] / length, jacobian[k, b, 1] / length
            borders[k, b] = not returned or min(before, abs(nx * to_x + ny * to_y)) > BORDER_M
            returned, x, y = True, x + to_x, y + to_y
