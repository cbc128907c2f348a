"""Exact ray casting against line segments and circles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array


def distances(segments: Array, circles: Array, poses: Array, angles: Array) -> Array:
    """(N, B) distances in m from poses (N, 3) along ``angles`` (B,) to the nearest segment (S, 4) or circle (C, 3).

    A segment is x0, y0, x1, y1 in m, a circle x, y, radius in m. The distance is +inf if nothing is hit.
    """
    # Temporary arrays of about 20 MB can be reused from one block to the next.
    block = max(1, 2_500_000 // (len(angles) * max(len(segments), 1)))
    parts = [_block(segments, circles, poses[i : i + block], angles) for i in range(0, len(poses), block)]
    return np.concatenate(parts) if parts else np.zeros((0, len(angles)))


def _block(segments: Array, circles: Array, poses: Array, angles: Array) -> Array:
    heading = poses[:, 2:3] + angles
    dx, dy = np.cos(heading)[..., None], np.sin(heading)[..., None]  # (N, B, 1)
    ax, ay = (segments[:, k] - poses[:, k : k + 1] for k in (0, 1))  # (N, S)
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]  # (S,)
    with np.errstate(divide="ignore", invalid="ignore"):
        det = dx * ey - dy * ex
        along = (ax * ey - ay * ex)[:, None, :] / det
        u = (ax[:, None, :] * dy - ay[:, None, :] * dx) / det
    hit = (along >= 0) & (u >= 0) & (u <= 1)
    best = np.where(hit, along, np.inf).min(axis=-1, initial=np.inf)
    for cx, cy, radius in circles:
        px, py = cx - poses[:, 0:1], cy - poses[:, 1:2]  # (N, 1)
        middle = px * dx[..., 0] + py * dy[..., 0]
        discriminant = middle**2 - (px**2 + py**2 - radius**2)
        near = middle - np.sqrt(np.where(discriminant >= 0, discriminant, np.nan))
        best = np.fmin(best, np.where(near >= 0, near, np.inf))
    return np.asarray(best)
