"""Seeds for global localisation, ranked against a scan."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise import beam_sums

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.shared.generative_models import GenerativeModel

PANORAMA_BINS = 360
SEED_SPACING_M = 0.3  # between the places at which a search begins
RANKED_HEADINGS, RANKED_BEAMS = 120, 72  # that are compared with the panorama of each place
MISFIT_TOLERANCE_M = 0.35  # typical error of a beam if the nearest seed is this far from the true place


@dataclass(frozen=True)
class Seeds:
    """Places in free space, with the panorama of ranges that the model expects at each."""

    places: Array  # (S, 2) m in map, of the laser
    # (S, PANORAMA_BINS) m, ranges in the directions 2 pi k / PANORAMA_BINS; NaN if unknown
    panoramas: np.ndarray[tuple[int, ...], np.dtype[np.float32]]

    @classmethod
    def at(cls, model: GenerativeModel, places: Array) -> Seeds:
        """Predicts the panorama at every place (S, 2)."""
        lasers = np.column_stack([places, np.zeros(len(places))])
        directions = np.linspace(0.0, 2 * np.pi, PANORAMA_BINS, endpoint=False)
        parts = []
        for part in np.array_split(lasers, max(1, len(lasers) // 500)):
            expected = model.expect(part, directions)
            parts.append(np.where(np.isinf(expected.scale), np.nan, expected.ranges).astype(np.float32))
        return cls(np.asarray(places, float), np.concatenate(parts))

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
        bins = np.round(thin.angles / (2 * np.pi / PANORAMA_BINS)).astype(np.int64)
        measured = thin.ranges.astype(np.float32)
        costs = np.empty((len(self.places), RANKED_HEADINGS), np.float32)
        tolerance, range_max = np.float32(MISFIT_TOLERANCE_M), np.float32(view.range_max)
        beam_sums.rank_places(self.panoramas, bins, measured, tolerance, range_max, costs)
        place, heading = _least_costs(costs, count)
        lasers = np.column_stack([self.places[place], se2.wrap(heading * (2 * np.pi / RANKED_HEADINGS))])
        return se2.compose(lasers, se2.inverse(view.mount))


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
