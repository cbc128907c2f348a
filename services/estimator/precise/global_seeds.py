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
# If there are more places than this, a comparison with few beams selects that many of them first.
FULLY_RANKED_PLACES, PRESELECTION_BEAMS = 4000, 24
RANGE_STEP_M = 0.1  # of a stored range; 0 is unknown
MAX_RANGE_STEPS = 255  # largest stored range, so that it fits a byte


@dataclass(frozen=True)
class Seeds:
    """Places in free space, with the panorama of ranges that the model expects at each."""

    places: Array  # (S, 2) m in map, of the laser
    # (S, 2, RANKED_HEADINGS) in steps of `RANGE_STEP_M`, in the direction of each ranked heading: ranges to the first
    # surface, and to the next behind it
    panoramas: npt.NDArray[np.uint8]

    @classmethod
    def at(cls, model: GenerativeModel, places: Array) -> Seeds:
        """Predicts the panorama at every place (S, 2)."""
        lasers = np.column_stack([places, np.zeros(len(places))])
        directions = np.linspace(0.0, 2 * np.pi, RANKED_HEADINGS, endpoint=False)
        panoramas = np.empty((len(lasers), 2, RANKED_HEADINGS), np.uint8)
        for begin in range(0, len(lasers), 500):
            part = slice(begin, begin + 500)
            expected = model.expect(lasers[part], directions)
            behind = model.expect_behind(lasers[part], directions, expected.ranges)
            panoramas[part, 0] = np.where(np.isinf(expected.scale), 0, _in_steps(expected.ranges))
            panoramas[part, 1] = _in_steps(behind)
        return cls(np.asarray(places, float), panoramas)

    @property
    def volume(self) -> float:
        """Volume in m² rad of the poses that the seeds represent."""
        return max(1, len(self.places)) * SEED_SPACING_M**2 * 2 * np.pi

    @property
    def starts_factor(self) -> float:
        """Number of starts of a search, divided by that in a map of up to `FULLY_RANKED_PLACES` places.

        The more places there are, the more of them look similar. The exponent was chosen on 50 000 m²: of 240 scans, a
        constant number of starts missed 11, of which this finds 7.
        """
        return float(max(1.0, len(self.places) / FULLY_RANKED_PLACES) ** (1 / 3))

    @cached_property
    def spread(self) -> Array:
        """Covariance (3, 3) of a completely unknown pose: uniform over the map and all headings."""
        extent = np.ptp(self.places, axis=0) if len(self.places) else np.ones(2)
        return np.diag([*np.maximum(extent, SEED_SPACING_M) ** 2 / 12, np.pi**2 / 3])

    def rank(self, view: View, count: int) -> Array:
        """The ``count`` base_link poses (count, 3) that fit the scan best, best first; at most two per place."""
        places, panoramas = self.places, self.panoramas
        if len(places) > FULLY_RANKED_PLACES:
            least, _ = _costs(panoramas, view.thinned(PRESELECTION_BEAMS), all_headings=False)
            chosen = np.sort(np.argsort(least, kind="stable")[:FULLY_RANKED_PLACES])
            places, panoramas = places[chosen], panoramas[chosen]
        least, costs = _costs(panoramas, view.thinned(RANKED_BEAMS))
        best = np.sort(np.argsort(least, kind="stable")[:count])
        place, heading = _least_costs(costs[best], count)
        headings = se2.wrap(heading * (2 * np.pi / RANKED_HEADINGS))
        lasers = np.column_stack([places[best[place]], headings])
        return se2.compose(lasers, se2.inverse(view.mount))


def _costs(
    panoramas: npt.NDArray[np.uint8], view: View, *, all_headings: bool = True
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
    """Misfit of a scan with each panorama: the least one (S,), and that of all headings (S, H), if wanted."""
    used = ~(np.isnan(view.ranges) | np.isneginf(view.ranges))
    bins = np.round(view.angles[used] / (2 * np.pi / RANKED_HEADINGS)).astype(np.int64) % RANKED_HEADINGS
    least = np.empty(len(panoramas), np.uint16)
    costs = np.empty((len(panoramas) if all_headings else 0, RANKED_HEADINGS), np.uint16)
    words = panoramas.view(np.uint64)
    words.flags.writeable = False  # as those of a file are: numba compiles again for others
    beam_sums.rank_places(
        words, bins, _in_steps(view.ranges[used]), int(_in_steps(np.array(view.range_max))), least, costs
    )
    return least, costs


def _in_steps(ranges: Array) -> npt.NDArray[np.uint8]:
    """Ranges in m as steps of `RANGE_STEP_M`, at least 1."""
    return np.clip(np.round(ranges / RANGE_STEP_M), 1, MAX_RANGE_STEPS).astype(np.uint8)


def _least_costs(costs: npt.NDArray[np.uint16], count: int) -> tuple[Array, Array]:
    """Indices of place and heading of the ``count`` lowest costs, with at most two separate headings per place."""
    rows = np.arange(len(costs))
    first = costs.argmin(axis=1)
    rest = costs.copy()
    for offset in range(-3, 4):
        rest[rows, (first + offset) % costs.shape[1]] = np.iinfo(np.uint16).max
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
