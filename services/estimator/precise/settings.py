"""Parameters of the precise estimator."""

from __future__ import annotations

from dataclasses import dataclass, field

from services.estimator.precise.motion_model import MotionNoise


@dataclass(frozen=True)
class Settings:
    """Thresholds and limits of the precise estimator; the defaults hold for every shipped world.

    The inlier ratio is the expected share of a scan's beams that the model explains (`Evidence.inlier_ratio`).
    """

    # Search
    search_seeds: int = 48  # poses from which the first round of a global search descends
    thorough_search_seeds: int = 240  # the same for the second round, if the first explains too little
    search_beams: int = 150  # beams used by the first descents of a search; the last ones use all beams
    conclusive_inlier_ratio: float = 0.9  # inlier ratio that ends a search
    inlier_ratio_drop: float = 0.1  # fall of the inlier ratio below its average that triggers a search
    energy_jump_nats: float = 150.0  # rise of accuracy above its average that triggers a search

    # Belief
    good_inlier_ratio: float = 0.75  # a scan with fewer inliers is not used as proof of a pose
    min_inlier_ratio: float = 0.45  # below it the pose is not believed, unless the missing beams are only blocked
    min_occluded_inlier_ratio: float = 0.15  # the same for a tracked pose whose missing beams are only blocked
    doubtful_inlier_ratio: float = 0.45  # below it a tracked pose that beams contradict is reported as lost
    max_contradicting_ratio: float = 0.05  # beams that may end behind the surface expected, as a share
    min_constraining_ratio: float = 0.004  # share of beams needed to fix the position along a corridor

    # State
    tracking_inlier_ratio: float = 0.75  # one scan with this inlier ratio is enough to report tracking
    min_scans_before_tracking: int = 30  # with a smaller ratio, a hypothesis must persist for this many scans
    max_tracking_deviation: float = 0.5  # m, standard deviation of the position above which tracking is not reported
    ambiguous_weight: float = 0.05  # weight of the second hypothesis above which the belief is ambiguous

    # Hypotheses
    max_hypotheses: int = 8
    evidence_error_nats: float = 20.0  # difference in energy between two poses that the model's error may cause
    rival_probation_scans: int = 100  # age at which a rival with a low inlier ratio may replace the tracked pose

    # Covariance
    inflation: float = 1.0  # factor on the covariance, because errors of the model are correlated between beams
    floor_position: float = 0.0  # m, standard deviation in x and in y that no number of scans removes
    floor_heading: float = 0.0  # rad

    motion: MotionNoise = field(default_factory=MotionNoise)
