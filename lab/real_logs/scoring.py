"""Which scans of a trial have a correct pose, and for how long a wrong one was reported as `tracking`.

A row is what `drive.trial` returns. Scans before a kidnapping are left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lab.real_logs.drive import KIDNAPPED, SCANS_BEFORE_KIDNAPPING
from lab.statistics import longest_duration

# A pose is correct if it is nearer than this to the reference.
CORRECT_DISTANCE_M, CORRECT_YAW_RAD = 0.5, float(np.deg2rad(10))

Mask = npt.NDArray[np.bool_]


def counted(row: dict[str, Any], name: str) -> npt.NDArray[Any]:
    """One column (N,) of the row, without the scans before a kidnapping."""
    return np.array(row[name][SCANS_BEFORE_KIDNAPPING if row["task"] == KIDNAPPED else 0 :])


def is_correct(row: dict[str, Any]) -> Mask:
    """Whether the pose is correct, for each scan that is not left out."""
    near = counted(row, "error_m") < CORRECT_DISTANCE_M
    return np.asarray(near & (counted(row, "yaw_error_rad") < CORRECT_YAW_RAD))


def is_tracking(row: dict[str, Any]) -> Mask:
    """Whether the state is `tracking`, for each scan that is not left out."""
    return np.asarray(counted(row, "state") == "tracking")


def scans_until_found(row: dict[str, Any]) -> int | None:
    """Number of scans until the state is `tracking` with a correct pose. Returns None if it never is."""
    found = is_correct(row) & is_tracking(row)
    return int(np.argmax(found)) + 1 if found.any() else None


def longest_wrong_s(row: dict[str, Any]) -> float:
    """Longest uninterrupted time in s in which the state was `tracking` with a wrong pose.

    A scan counts for the time until the next one, the last for the median of these times.
    """
    periods = np.diff(counted(row, "stamp_s"))
    periods = np.append(periods, np.median(periods) if len(periods) else 0.0)
    return longest_duration(is_tracking(row) & ~is_correct(row), periods)
