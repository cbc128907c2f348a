"""Parameters of the precise estimator."""

from __future__ import annotations

from dataclasses import dataclass, field

from services.estimator.precise.motion_model import MotionNoise


@dataclass(frozen=True)
class PreciseSettings:
    """Parameters of the precise estimator, which depend on the model, its calibration and the robot."""

    min_explained_fraction: float = 0.75  # if the map explains fewer of the beams, recent scans give the motion
    inflation: float = 1.0  # factor on the covariance, because errors of the model are correlated between beams
    floor_position: float = 0.0  # m, standard deviation in x and in y that no number of scans removes
    floor_heading: float = 0.0  # rad
    motion: MotionNoise = field(default_factory=MotionNoise)
