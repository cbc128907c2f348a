"""Where to begin when nothing is known: places over free space, all headings, ranked against the scan in one pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from common import se2
from services.estimator import kernels

if TYPE_CHECKING:
    from common.se2 import Array
    from services.estimator.generative import GenerativeModel
    from services.estimator.precise.gauss_newton import View

BINS = 360  # of a cached panorama
SPACING = 0.3  # m between the places a search begins at
TOLERANCE = 0.35  # m, misfit of a beam that still speaks for a place about as far from the truth


@dataclass(frozen=True)
class Seeds:
    """Panoramas expected at places over free space."""

    places: Array  # (S, 2) m in map, of the laser
    panoramas: np.ndarray[tuple[int, ...], np.dtype[np.float32]]  # (S, BINS) m in direction 2 pi k / BINS of map

    @classmethod
    def at(cls, model: GenerativeModel, places: Array) -> Seeds:
        """Ask the model for every place (S, 2)."""
        lasers = np.column_stack([places, np.zeros(len(places))])
        directions = np.linspace(0.0, 2 * np.pi, BINS, endpoint=False)
        parts = [model.expect(part, directions).ranges for part in np.array_split(lasers, max(1, len(lasers) // 500))]
        return cls(np.asarray(places, float), np.concatenate(parts).astype(np.float32))

    @property
    def volume(self) -> float:
        """M² rad that places and headings stand for."""
        return max(1, len(self.places)) * SPACING**2 * 2 * np.pi

    @property
    def spread(self) -> Array:
        """(3, 3) covariance of a pose of which nothing is known."""
        extent = np.ptp(self.places, axis=0) if len(self.places) else np.ones(2)
        return np.diag([*np.maximum(extent, SPACING) ** 2 / 12, np.pi**2 / 3])

    def rank(self, view: View, count: int, headings: int = 120, beams: int = 72) -> Array:
        """(count, 3) base_link poses that fit the scan best, best first; a place gives at most two headings."""
        thin = view.thinned(beams)
        bins = np.round(thin.angles / (2 * np.pi / BINS)).astype(np.int64)
        costs = np.empty((len(self.places), headings), np.float32)
        kernels.rank(
            self.panoramas,
            bins,
            thin.ranges.astype(np.float32),
            np.float32(TOLERANCE),
            np.float32(view.range_max),
            costs,
        )
        place, heading = _least(costs, count)
        lasers = np.column_stack([self.places[place], se2.wrap(heading * (2 * np.pi / headings))])
        return se2.compose(lasers, se2.inverse(view.mount))


def _least(costs: np.ndarray[tuple[int, ...], np.dtype[np.float32]], count: int) -> tuple[Array, Array]:
    """Place and heading of the ``count`` least costs, two headings apart at most for each place."""
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
    """Of points (N, 2) m one for each square of a grid of ``spacing`` m, the one nearest its centre."""
    cell = np.floor(points / spacing)
    off = np.abs(points / spacing - cell - 0.5).max(axis=1)
    order = np.lexsort([off, cell[:, 1], cell[:, 0]])
    cell = cell[order]
    first = np.concatenate([[True], (np.diff(cell, axis=0) != 0).any(axis=1)])
    return np.asarray(points[order[first]])
