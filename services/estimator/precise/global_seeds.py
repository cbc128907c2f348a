"""Seeds for global localisation, ranked against a scan."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from services.estimator.precise import beam_sums

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.shared.generative_models import GenerativeModel

SEED_SPACING_M = 0.3  # between the places at which a search begins
RANKED_HEADINGS, RANKED_BEAMS = 120, 72  # that are compared with the panorama of each place
PANORAMA_PHASES = 3  # directions of a panorama for each of these headings
PANORAMA_BINS = PANORAMA_PHASES * RANKED_HEADINGS
RANGE_STEP_M = 0.002  # of a stored range; 0 is unknown
RANKED_PLACES = 1000  # that are best by a rough comparison and ranked exactly
ROUGH_SHIFT = 6  # bits by which that comparison shortens stored ranges, to steps of 0.128 m
MISFIT_TOLERANCE_M = 0.35  # typical error of a beam if the nearest seed is this far from the true place

StoredRanges = npt.NDArray[np.uint16]


@dataclass(frozen=True)
class Seeds:
    """Places in free space, with the panorama of ranges that the model expects at each."""

    places: Array  # (S, 2) m in map, of the laser
    # (S, PANORAMA_PHASES, RANKED_HEADINGS) ranges in the directions 2 pi (PANORAMA_PHASES k + phase) / PANORAMA_BINS
    panoramas: StoredRanges

    @classmethod
    def at(cls, model: GenerativeModel, places: Array) -> Seeds:
        """Predicts the panorama at every place (S, 2)."""
        lasers = np.column_stack([places, np.zeros(len(places))])
        directions = np.linspace(0.0, 2 * np.pi, PANORAMA_BINS, endpoint=False)
        panoramas = np.empty((len(lasers), PANORAMA_PHASES, RANKED_HEADINGS), np.uint16)
        for begin in range(0, len(lasers), 500):
            expected = model.expect(lasers[begin : begin + 500], directions)
            steps = np.clip(np.round(expected.ranges / RANGE_STEP_M), 1, np.iinfo(np.uint16).max)
            steps = np.where(np.isinf(expected.scale), 0, steps).reshape(-1, RANKED_HEADINGS, PANORAMA_PHASES)
            panoramas[begin : begin + 500] = steps.transpose(0, 2, 1)
        return cls(np.asarray(places, float), panoramas)

    @property
    def volume(self) -> float:
        """Volume in m² rad of the poses that the seeds represent."""
        return max(1, len(self.places)) * SEED_SPACING_M**2 * 2 * np.pi

    @cached_property
    def spread(self) -> Array:
        """Covariance (3, 3) of a completely unknown pose: uniform over the map and all headings."""
        extent = np.ptp(self.places, axis=0) if len(self.places) else np.ones(2)
        return np.diag([*np.maximum(extent, SEED_SPACING_M) ** 2 / 12, np.pi**2 / 3])

    def rank(self, view: View, count: int) -> Array:
        """The ``count`` base_link poses (count, 3) that fit the scan best, best first; at most two per place."""
        thin = view.thinned(RANKED_BEAMS)
        used = ~(np.isnan(thin.ranges) | np.isneginf(thin.ranges))
        bins = np.round(thin.angles[used] / (2 * np.pi / PANORAMA_BINS)).astype(np.int64) % PANORAMA_BINS
        measured = np.minimum(thin.ranges[used], view.range_max)
        candidates = self._best_places(bins, measured, view.range_max)
        steps = self.panoramas[candidates].transpose(0, 2, 1).reshape(-1, PANORAMA_BINS)
        panoramas = np.where(steps > 0, steps * np.float32(RANGE_STEP_M), np.float32(np.nan))
        costs = np.empty((len(candidates), RANKED_HEADINGS), np.float32)
        tolerance, range_max = np.float32(MISFIT_TOLERANCE_M), np.float32(view.range_max)
        beam_sums.rank_places(panoramas, bins, measured.astype(np.float32), tolerance, range_max, costs)
        place, heading = _least_costs(costs, count)
        headings = se2.wrap(heading * (2 * np.pi / RANKED_HEADINGS))
        lasers = np.column_stack([self.places[candidates[place]], headings])
        return se2.compose(lasers, se2.inverse(view.mount))

    def _best_places(self, bins: npt.NDArray[np.int64], measured: Array, range_max: float) -> npt.NDArray[np.intp]:
        """Indices of the `RANKED_PLACES` that fit best by a rough comparison, in ascending order."""
        steps = np.minimum(measured / RANGE_STEP_M, np.iinfo(np.uint16).max).astype(np.uint16)
        costs = np.empty(len(self.places), np.uint16)
        beam_sums.rank_roughly(self.panoramas, bins, steps, int(range_max / RANGE_STEP_M), ROUGH_SHIFT, costs)
        return np.sort(np.argsort(costs, kind="stable")[:RANKED_PLACES])


def _least_costs(costs: np.ndarray[tuple[int, ...], np.dtype[np.float32]], count: int) -> tuple[Array, Array]:
    """Indices of place and heading of the ``count`` lowest costs, with at most two separate headings per place."""
    rows = np.arange(len(costs))
    first = costs.argmin(axis=1)
    rest = costs.copy()
    for offset in range(-3, 4):
        rest[rows, (first + offset) % costs.shape[1]] = np.inf
    second = rest.argmin(axis=1)
    place = np.concatenate([rows, rows])
    heading = np.concatenate([first, second])
    order = np.argsort(np.concatenate([costs[rows, first], costs[rows, second]]), kind="stable")[:count]
    return place[order], heading[order]


def thin_places(points: Array, spacing: float) -> Array:
    """Selects from points (N, 2) m the one nearest the centre of each square of a grid of ``spacing`` m."""
    cell = np.floor(points / spacing)
    off = np.abs(points / spacing - cell - 0.5).max(axis=1)
    order = np.lexsort([off, cell[:, 1], cell[:, 0]])
    cell = cell[order]
    first = np.concatenate([[True], (np.diff(cell, axis=0) != 0).any(axis=1)])
    return np.asarray(points[order[first]])
