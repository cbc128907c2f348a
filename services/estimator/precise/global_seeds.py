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
# Displacements in the laser frame (9, 2) m. A scan changes much over half of `SEED_SPACING_M`, and displacing the scan
# costs less memory than more panoramas.
SHIFTS_M = 0.1 * np.stack(np.meshgrid([0.0, 1.0, -1.0], [0.0, 1.0, -1.0]), axis=-1).reshape(-1, 2)
# If there are more places, comparisons with few beams select as many of them first: one without displacements, if there
# are more than the first number, and one with them, if there are more than the second.
COARSELY_RANKED_PLACES, FULLY_RANKED_PLACES, PRESELECTION_BEAMS = 20_000, 1000, 24
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

    @cached_property
    def spread(self) -> Array:
        """Covariance (3, 3) of a completely unknown pose: uniform over the map and all headings."""
        extent = np.ptp(self.places, axis=0) if len(self.places) else np.ones(2)
        return np.diag([*np.maximum(extent, SEED_SPACING_M) ** 2 / 12, np.pi**2 / 3])

    def rank(self, view: View, count: int) -> Array:
        """The ``count`` base_link poses (count, 3) that fit the scan best, best first; at most two per place."""
        places, panoramas, few = self.places, self.panoramas, view.thinned(PRESELECTION_BEAMS)
        for most, shifts in ((COARSELY_RANKED_PLACES, SHIFTS_M[:1]), (FULLY_RANKED_PLACES, SHIFTS_M)):
            if len(places) > most:
                chosen = np.sort(np.argsort(_least_misfits(panoramas, few, shifts), kind="stable")[:most])
                places, panoramas = places[chosen], panoramas[chosen]
        costs, shift = _misfits(panoramas, view.thinned(RANKED_BEAMS))
        place, heading = _select(costs, count)
        headings = se2.wrap(heading * (2 * np.pi / RANKED_HEADINGS))
        centres = np.column_stack([places[place], headings])
        displacement = SHIFTS_M[shift[place, heading]]
        lasers = se2.compose(centres, np.column_stack([displacement, np.zeros(len(place))]))
        return se2.compose(lasers, se2.inverse(view.mount))


def _least_misfits(panoramas: npt.NDArray[np.uint8], view: View, shifts: Array) -> npt.NDArray[np.uint16]:
    """Misfit (S,) of a scan with each panorama, at the best heading and the best of the displacements (K, 2)."""
    least = np.full(len(panoramas), np.iinfo(np.uint16).max, np.uint16)
    one = np.empty_like(least)
    for shift in shifts:
        _compare(panoramas, view, shift, one, np.empty((0, RANKED_HEADINGS), np.uint16))
        np.minimum(least, one, out=least)
    return least


def _misfits(panoramas: npt.NDArray[np.uint8], view: View) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.intp]]:
    """Misfit (S, H) of a scan with each panorama at each heading, and the number of the best displacement (S, H)."""
    least = np.empty(len(panoramas), np.uint16)
    costs = np.empty((len(SHIFTS_M), len(panoramas), RANKED_HEADINGS), np.uint16)
    for shift, each in zip(SHIFTS_M, costs, strict=True):
        _compare(panoramas, view, shift, least, each)
    best = costs.argmin(axis=0)
    return np.take_along_axis(costs, best[None], axis=0)[0], best


def _compare(
    panoramas: npt.NDArray[np.uint8],
    view: View,
    shift: Array,
    least: npt.NDArray[np.uint16],
    costs: npt.NDArray[np.uint16],
) -> None:
    """Fills ``least`` and ``costs`` (see `beam_sums.rank_places`), for the laser displaced by ``shift`` (2,) m."""
    used = ~(np.isnan(view.ranges) | np.isneginf(view.ranges))
    angles, ranges = view.angles[used], view.ranges[used]
    ended = np.isfinite(ranges)
    ends = ranges[ended, None] * np.stack([np.cos(angles[ended]), np.sin(angles[ended])], axis=-1) + shift
    angles[ended], ranges[ended] = np.arctan2(ends[:, 1], ends[:, 0]), np.hypot(*ends.T)
    bins = np.round(angles / (2 * np.pi / RANKED_HEADINGS)).astype(np.int64) % RANKED_HEADINGS
    words = panoramas.view(np.uint64)
    words.flags.writeable = False  # as those of a file are: numba compiles again for others
    beam_sums.rank_places(words, bins, _in_steps(ranges), int(_in_steps(np.array(view.range_max))), least, costs)


def _in_steps(ranges: Array) -> npt.NDArray[np.uint8]:
    """Ranges in m as steps of `RANGE_STEP_M`, at least 1."""
    return np.clip(np.round(ranges / RANGE_STEP_M), 1, MAX_RANGE_STEPS).astype(np.uint8)


def _select(costs: npt.NDArray[np.uint16], count: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Places and headings of the ``count`` lowest costs (S, H), with at most two separate headings per place."""
    best = np.sort(np.argsort(costs.min(axis=1), kind="stable")[:count])
    rows = np.arange(len(best))
    first = costs[best].argmin(axis=1)
    rest = costs[best]
    for offset in range(-3, 4):
        rest[rows, (first + offset) % costs.shape[1]] = np.iinfo(np.uint16).max
    second = rest.argmin(axis=1)
    place = np.concatenate([best, best])
    heading = np.concatenate([first, second])
    order = np.argsort(costs[place, heading], kind="stable")[:count]
    return place[order], heading[order]


def thin_places(points: Array, spacing: float) -> Array:
    """Selects from points (N, 2) m the one nearest the centre of each square of a grid of ``spacing`` m."""
    cell = np.floor(points / spacing)
    off = np.abs(points / spacing - cell - 0.5).max(axis=1)
    order = np.lexsort([off, cell[:, 1], cell[:, 0]])
    cell = cell[order]
    first = np.concatenate([[True], (np.diff(cell, axis=0) != 0).any(axis=1)])
    return np.asarray(points[order[first]])
