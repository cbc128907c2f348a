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
    from services.estimator.precise.scan_likelihood import ScanLikelihood
    from services.estimator.shared.generative_models import GenerativeModel

SEED_SPACING_M = 0.3  # between the places at which a search begins
RANKED_HEADINGS = 120  # at each place, 3 degrees apart
# Displacements (9, 2) m of the laser, in its frame, with which each panorama is compared: a third of the spacing; the
# first is zero. A scan changes much over half of the spacing, and displacements take less memory than more panoramas.
DISPLACEMENTS_M = 0.1 * np.stack(np.meshgrid([0, 1, -1], [0, 1, -1]), axis=-1).reshape(-1, 2)
# A large map is ranked in stages, so that most places are compared with few beams only:
PRESELECTION_BEAMS = 24  # or more, in the first two stages
COARSELY_SELECTED_PLACES = 20_000  # kept by the first stage, which has no displacements
FINELY_SELECTED_PLACES = 1000  # kept by the second stage, which has
RANKED_BEAMS = 72  # or more, in the last stage
MIN_HEADING_STEPS = 4  # 12 degrees, between the two headings that are kept at a place
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
        return len(self.places) * SEED_SPACING_M**2 * 2 * np.pi

    @cached_property
    def spread(self) -> Array:
        """Covariance (3, 3) of a completely unknown pose: uniform over the map and all headings."""
        extent = np.ptp(self.places, axis=0)
        return np.diag([*np.maximum(extent, SEED_SPACING_M) ** 2 / 12, np.pi**2 / 3])

    def rank(self, scan: ScanLikelihood, count: int) -> Array:
        """The ``count`` base_link poses (count, 3) that fit the scan best, best first; at most two per place."""
        places, panoramas, thinned = self.places, self.panoramas, scan.thinned(PRESELECTION_BEAMS)
        stages = ((COARSELY_SELECTED_PLACES, DISPLACEMENTS_M[:1]), (FINELY_SELECTED_PLACES, DISPLACEMENTS_M))
        for max_places, displacements in stages:
            if len(places) > max_places:
                misfits = _least_misfits(panoramas, thinned, displacements)
                selected = np.sort(np.argsort(misfits, kind="stable")[:max_places])
                places, panoramas = places[selected], panoramas[selected]
        misfits, best_displacement = _misfits(panoramas, scan.thinned(RANKED_BEAMS))
        place, heading = _select(misfits, count)
        lasers = np.column_stack([places[place], se2.wrap(heading * (2 * np.pi / RANKED_HEADINGS))])
        displacements = DISPLACEMENTS_M[best_displacement[place, heading]]
        lasers = se2.compose(lasers, np.column_stack([displacements, np.zeros(len(lasers))]))
        return se2.compose(lasers, se2.inverse(scan.mount))


def _least_misfits(
    panoramas: npt.NDArray[np.uint8], scan: ScanLikelihood, displacements: Array
) -> npt.NDArray[np.uint16]:
    """Misfit (S,) of a scan with each panorama, at the best heading and the best of the displacements (K, 2)."""
    no_headings = np.empty((0, RANKED_HEADINGS), np.uint16)
    misfits = [_compare(panoramas, scan, each, no_headings) for each in displacements]
    return np.asarray(np.min(misfits, axis=0))


def _misfits(
    panoramas: npt.NDArray[np.uint8], scan: ScanLikelihood
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.intp]]:
    """Misfit (S, H) of a scan with each panorama at each heading, and the index (S, H) of the best displacement."""
    misfits = np.empty((len(DISPLACEMENTS_M), len(panoramas), RANKED_HEADINGS), np.uint16)
    for displacement, each in zip(DISPLACEMENTS_M, misfits, strict=True):
        _compare(panoramas, scan, displacement, each)
    best = misfits.argmin(axis=0)
    return np.take_along_axis(misfits, best[None], axis=0)[0], best


def _compare(
    panoramas: npt.NDArray[np.uint8], scan: ScanLikelihood, displacement: Array, misfits: npt.NDArray[np.uint16]
) -> npt.NDArray[np.uint16]:
    """Returns the least misfit (S,) of a scan with each panorama if the laser is displaced by ``displacement`` (2,) m.

    Fills ``misfits`` (S, H) with those of all headings, unless it is empty.
    """
    used = ~(np.isnan(scan.ranges) | np.isneginf(scan.ranges))
    angles, ranges = scan.angles[used], scan.ranges[used]
    returned = np.isfinite(ranges)
    directions = np.stack([np.cos(angles[returned]), np.sin(angles[returned])], axis=-1)
    end_points = ranges[returned, None] * directions + displacement
    angles[returned], ranges[returned] = np.arctan2(end_points[:, 1], end_points[:, 0]), np.hypot(*end_points.T)
    bins = np.round(angles / (2 * np.pi / RANKED_HEADINGS)).astype(np.int64) % RANKED_HEADINGS
    words = panoramas.view(np.uint64)
    words.flags.writeable = False  # as arrays from a file are: numba would compile once more for others
    least = np.empty(len(panoramas), np.uint16)
    beam_sums.rank_places(words, bins, _in_steps(ranges), int(_in_steps(np.array(scan.range_max))), least, misfits)
    return least


def _in_steps(ranges: Array) -> npt.NDArray[np.uint8]:
    """Ranges in m as steps of `RANGE_STEP_M`, at least 1."""
    return np.clip(np.round(ranges / RANGE_STEP_M), 1, MAX_RANGE_STEPS).astype(np.uint8)


def _select(misfits: npt.NDArray[np.uint16], count: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Indices of place and heading of the ``count`` least misfits (S, H), at most two headings per place."""
    best = np.sort(np.argsort(misfits.min(axis=1), kind="stable")[:count])
    rows = np.arange(len(best))
    first = misfits[best].argmin(axis=1)
    rest = misfits[best]
    for step in range(-MIN_HEADING_STEPS + 1, MIN_HEADING_STEPS):
        rest[rows, (first + step) % misfits.shape[1]] = np.iinfo(np.uint16).max
    second = rest.argmin(axis=1)
    place = np.concatenate([best, best])
    heading = np.concatenate([first, second])
    order = np.argsort(misfits[place, heading], kind="stable")[:count]
    return place[order], heading[order]


def thin_places(points: Array, spacing: float) -> Array:
    """Selects from points (N, 2) m the one nearest the centre of each square of a grid of ``spacing`` m."""
    cell = np.floor(points / spacing)
    off = np.abs(points / spacing - cell - 0.5).max(axis=1)
    order = np.lexsort([off, cell[:, 1], cell[:, 0]])
    cell = cell[order]
    first = np.concatenate([[True], (np.diff(cell, axis=0) != 0).any(axis=1)])
    return np.asarray(points[order[first]])
