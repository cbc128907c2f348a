"""Parameters of the precise estimator."""

from __future__ import annotations

from dataclasses import dataclass, field

from services.estimator.precise.motion_model import MotionNoise


@dataclass(frozen=True)
class PreciseSettings:
    """Parameters of the precise estimator; the defaults are used for every shipped world."""

    # Search
    ranked_seeds: int = 300  # seeds at which the evidence by surfaces is computed
    search_starts: int = 48  # the best of them, from which a search of the whole map descends
    search_beams: int = 100  # beams used by these descents
    search_results: int = 12  # results of them, from which it descends with all beams
    near_starts: int = 48  # poses from which a search near a given pose descends
    max_hypotheses: int = 8

    # Tracking
    min_explained_fraction: float = 0.75  # if the map explains fewer of the beams, recent scans give the motion

    # Belief. The probabilities are guesses.
    unknown_probability: float = 1e-5  # least probability that the robot is at none of the hypotheses
    off_map_probability: float = 0.01  # if so, of being at a place that no search of the map finds
    all_changed_probability: float = 1e-2  # that nothing around the start is as the map shows it
    tracking_probability: float = 0.999  # of the pose being within 0.2 m and 5 degrees of the truth
    # Weight of the second hypothesis above which the belief is ambiguous. It is at any weight if only other hypotheses
    # keep it from being tracked.
    ambiguous_weight: float = 0.05

    # Covariance
    inflation: float = 1.0  # factor on the covariance, because errors of the model are correlated between beams
    floor_position: float = 0.0  # m, standard deviation in x and in y that no number of scans removes
    floor_heading: float = 0.0  # rad

    motion: MotionNoise = field(default_factory=MotionNoise)
