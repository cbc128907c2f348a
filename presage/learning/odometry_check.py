"""Compares the odometry of a drive with the poses computed from its scans."""

from __future__ import annotations

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array

MIN_DISTANCE_M, MIN_TURN_RAD = 0.2, 0.15  # of a motion that is compared; the relative error of smaller ones is large
MIN_MOTIONS = 10
MAX_SCALE_ERROR, MAX_DIRECTION_ERROR_DEG = 0.1, 5.0  # tolerated; the errors of most odometries are smaller


def odometry_warnings(poses: Array, odom: Array) -> list[str]:
    """Contradictions between ``odom`` (N, 3) and the ``poses`` (N, 3) at the same times; rows may be NaN.

    Medians of the motions between successive rows are compared, so slipping wheels and single wrong poses do not count.
    """
    by_scans, by_odom = se2.between(poses[:-1], poses[1:]), se2.between(odom[:-1], odom[1:])
    known = np.isfinite(by_scans).all(axis=1) & np.isfinite(by_odom).all(axis=1)
    by_scans, by_odom = by_scans[known], by_odom[known]
    warnings = []
    turned = np.abs(by_scans[:, 2]) > MIN_TURN_RAD
    if turned.sum() >= MIN_MOTIONS:
        ratio = float(np.median(by_odom[turned, 2] / by_scans[turned, 2]))
        if ratio < -0.5:
            # The scans are then a mirror image, so that distances and directions say nothing.
            problem = "the odometry turns right where the scans turn left"
            return [f"{problem}: if the laser is upside down, set upside_down: true in section log of --config"]
        if abs(ratio - 1) > MAX_SCALE_ERROR:
            warnings.append(f"the odometry reports {ratio:.2f} times the turns of the scans: is the track width right?")
    x, y, _ = by_scans.T
    driven = np.hypot(x, y) > MIN_DISTANCE_M
    if driven.sum() >= MIN_MOTIONS:
        # As complex numbers: the absolute value of a ratio is that of the distances, its angle that of the directions.
        ratios = (by_odom[driven, 0] + 1j * by_odom[driven, 1]) / (x + 1j * y)[driven]
        median = complex(np.median(ratios.real), np.median(ratios.imag))
        direction = float(np.rad2deg(np.angle(median)))
        if abs(abs(median) - 1) > MAX_SCALE_ERROR:
            warnings.append(
                f"the odometry reports {abs(median):.2f} times the distances of the scans: are the wheel radius and "
                "the unit of the ranges right?"
            )
        elif abs(direction) > MAX_DIRECTION_ERROR_DEG:
            warnings.append(
                f"the odometry drives {abs(direction):.0f} deg to the {'left' if direction > 0 else 'right'} of the "
                "direction that the scans show: is the yaw of the laser's mount right?"
            )
    return warnings
