"""Seeds for global localisation, ranked against a scan."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.shared import kernels
from services.estimator.shared.asking import without_pause

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.gauss_newton import View
    from services.estimator.shared.asking import Pieces
    from services.estimator.shared.generative_models import GenerativeModel

BINS = 360  # of a cached panorama
SPACING = 0.3  # m between the places a search begins at
LOOKS = 40  # into a panorama take as long as the prediction of one beam
TOLERANCE = 0.35  # m, misfit of a beam that still speaks for a place about as far from the truth


@dataclass(frozen=True)
class Seeds:
    """Panoramas expected at places over free space."""

    places: Array  # (S, 2) m in map, of the laser
    panoramas: np.ndarray[
        tuple[int, ...], np.dtype[np.float32]
    ]  # (S, BINS) m in direction 2 pi k / BINS; NaN: not known

    @classmethod
    def at(cls, model: GenerativeModel, places: Array) -> Seeds:
        """Ask the model for every place (S, 2)."""
        lasers = np.column_stack([places, np.zeros(len(places))])
        directions = np.linspace(0.0, 2 * np.pi, BINS, endpoint=False)
        parts = []
        for part in np.array_split(lasers, max(1, len(lasers) // 500)):
            seen = model.expect(part, directions)
            parts.append(np.where(np.isinf(seen.scale), np.nan, seen.ranges).astype(np.float32))
        return cls(np.asarray(places, float), np.concatenate(parts))

    @property
    def volume(self) -> float:
        """M² rad that places and headings stand for."""
        return max(1, len(self.places)) * SPACING**2 * 2 * np.pi

    @property
    def spread(self) -> Array:
        """(3, 3) covariance of a pose of which nothing is known."""
        extent = np.ptp(self.places, axis=0) if len(self.places) else np.ones(2)
        return np.diag([*np.maximum(extent, SPACING) ** 2 / 12, np.pi**2 / 3])

    def rank(self, view: View, count: int) -> Array:
        """(count, 3) base_link poses that fit the scan best, best first; a place gives at most two headings."""
        return Ranking(self, view, count).answer()


@dataclass(frozen=True)
class Ranking:
    """The question a search begins with (see `asking`), answered by the starts of a descent: `Seeds.rank`."""

    seeds: Seeds
    view: View
    count: int
    headings: int = 120
    thinned: int = 72  # beams that are compared

    @property
    def alike(self) -> Hashable:
        """Each on its own: there is nothing to share."""
        return id(self)

    @property
    def beams(self) -> int:
        """Of predictions that take as long as these looks into a table."""
        return len(self.seeds.places) * self.headings * self.thinned // LOOKS

    def answer(self) -> Array:
        """Now."""
        return without_pause(self.in_pieces(self.beams + 1))

    def answer_all(self, questions: Sequence[Ranking]) -> list[Array]:
        """One after the other."""
        return [question.answer() for question in questions]

    def in_pieces(self, beams: int) -> Pieces[Array]:
        """A few places at a time."""
        seeds, thin = self.seeds, self.view.thinned(self.thinned)
        bins = np.round(thin.angles / (2 * np.pi / BINS)).astype(np.int64)
        measured = thin.ranges.astype(np.float32)
        costs = np.empty((len(seeds.places), self.headings), np.float32)
        rows = max(1, beams * LOOKS // (self.headings * self.thinned))
        for begin in range(0, len(costs), rows):
            if begin:
                yield
            part = slice(begin, begin + rows)
            kernels.rank(
                seeds.panoramas[part], bins, measured, np.float32(TOLERANCE), np.float32(self.view.range_max),
                costs[part],
            )  # fmt: skip
        place, heading = _least(costs, self.count)
        lasers = np.column_stack([seeds.places[place], se2.wrap(heading * (2 * np.pi / self.headings))])
        return se2.compose(lasers, se2.inverse(self.view.mount))


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
