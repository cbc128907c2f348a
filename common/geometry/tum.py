"""Writes a trajectory in TUM format: a pose per line, `timestamp x y z qx qy qz qw` in s and m."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from common.geometry.se2 import Array


def write_tum(path: Path, stamps: Array, poses: Array, frame: str = "base_link") -> None:
    """Writes poses (N, 3) of ``frame`` in map at ``stamps`` (N,) s."""
    x, y, yaw = poses.T
    zero = np.zeros(len(x))
    rows = np.column_stack([stamps, x, y, zero, zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)])
    np.savetxt(path, rows, fmt="%.9f", header=f"{frame} in map: timestamp x y z qx qy qz qw")
