"""Corrects scans for the motion of the robot while the scanner measured one beam after another.

A scan is corrected to the middle of its sweep. There, an error of the velocity shifts the first beams one way and the
last ones the other, and so hardly changes the pose that is found. The pose at the stamp, when the first beam was
measured, follows from that pose and the velocity since the scan before.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from common.geometry import se2
from common.robot.motion_distortion import beam_times, correct_beams, sweep_time

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.shared.interface import Observation


def correct_motion(
    observation: Observation, velocity: Array | None, mount: Array, displacements: Array | float = 0.0
) -> Observation:
    """The observation as if all beams had been measured in the middle of the sweep; ``mount`` (3,) is the laser.

    The robot moves with ``velocity`` (3,), m/s, m/s and rad/s in base_link. At each beam it is displaced from that
    motion by ``displacements`` (B, 3), m, m and rad in base_link. If the velocity is unknown, the observation is
    unchanged.
    """
    if velocity is None or not observation.time_increment:
        return observation
    times = times_from_middle(observation)
    ranges, angles = correct_beams(
        observation.ranges, observation.angles, times[:, None] * velocity + displacements, mount
    )
    return replace(observation, ranges=ranges, angles=angles, time_increment=0.0)


def pose_at_stamp(pose: Array, velocity: Array | None, period: float, observation: Observation) -> Array:
    """The pose (3,) at the stamp, from that in the middle of the sweep.

    ``velocity`` (3,) is the mean since the scan before, ``period`` s ago, in base_link at that scan.
    """
    if velocity is None or not observation.time_increment:
        return pose
    back = se2.inverse(velocity * period)
    return se2.compose(pose, back * (_middle(observation) / period))


def times_from_middle(observation: Observation) -> Array:
    """Times (B,) in s of the beams, from the middle of the sweep."""
    return beam_times(len(observation.angles), observation.time_increment) - _middle(observation)


def _middle(observation: Observation) -> float:
    """Time in s from the first beam to the middle of the sweep."""
    return sweep_time(len(observation.angles), observation.time_increment) / 2
