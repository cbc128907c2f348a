"""Parameters of the precise estimator."""

from __future__ import annotations

from dataclasses import dataclass, field

from services.estimator.precise.motion_model import MotionNoise


@dataclass(frozen=True)
class Settings:
    """Parameters of the precise estimator; the defaults hold for every shipped world."""

    # Search
    search_seeds: int = 48  # poses from which a search descends
    search_beams: int = 150  # beams used by the first descents of a search; the last ones use all beams
    max_hypotheses: int = 8

    # Following
    matching_share: float = 0.75  # with a smaller share of explained beams, the scan is matched to recent scans too
    drop: float = 0.1  # fall of the share of explained beams from one scan to the next that widens the descent
    min_constraining_ratio: float = 0.004  # share of beams needed to fix the position along a corridor

    # Belief
    unknown: float = 1e-5  # probability that the robot is at none of the hypotheses: never less than this
    all_changed: float = 1e-2  # probability that nothing around the start is as the map shows it
    unmapped: float = 1e-3  # of that, the probability that the robot is at no place that a search of the map finds
    change_rate: float = 0.015  # 1/s, at which a surface in view is taken away or put there
    tracking_probability: float = 0.999  # of the pose being within 0.2 m and 5 degrees of the truth
    ambiguous_weight: float = 0.05  # weight of the second hypothesis above which the belief is ambiguous

    # Covariance
    inflation: float = 1.0  # factor on the covariance, because errors of the model are correlated between beams
    floor_position: float = 0.0  # m, standard deviation in x and in y that no number of scans removes
    floor_heading: float = 0.0  # rad

    motion: MotionNoise = field(default_factory=MotionNoise)
