"""Counts the scans that observed each cell of a grid, compiled by numba.

numba keeps the compiled code beside this file, or in NUMBA_CACHE_DIR, so it is compiled once per machine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from common.geometry.se2 import Array


@numba.njit(cache=True, nogil=True, error_model="numpy")
def count_scans(
    lasers: Array, ranges: Array, angles: Array, h: float, hits: npt.NDArray[np.int64], passes: npt.NDArray[np.int64]
) -> None:
    """Adds, for each cell of ``h`` m, the scans with a beam that ended in it, and the scans whose beams only passed it.

    Scans have laser poses (N, 3), m from the corner of cell (0, 0), and ranges (N, B) m at ``angles`` (B,) rad; a
    beam whose range is not finite and positive is left out.
    """
    rows, columns = hits.shape
    hit, passed = np.full(hits.shape, -1), np.full(hits.shape, -1)  # the last scan that did
    for n in range(len(lasers)):
        for stage in range(2):  # ends first, because they take precedence
            for b in range(len(angles)):
                r = ranges[n, b]
                if not 0.0 < r < np.inf:
                    continue
                ux, uy = np.cos(lasers[n, 2] + angles[b]), np.sin(lasers[n, 2] + angles[b])
                for k in range(1 if stage == 0 else int(np.ceil(2.0 * r / h))):
                    t = r if stage == 0 else 0.5 * h * k
                    i, j = int(np.floor((lasers[n, 1] + t * uy) / h)), int(np.floor((lasers[n, 0] + t * ux) / h))
                    if not (0 <= i < rows and 0 <= j < columns) or hit[i, j] == n:
                        continue
                    if stage == 0:
                        hit[i, j] = n
                        hits[i, j] += 1
                    elif passed[i, j] != n:
                        passed[i, j] = n
                        passes[i, j] += 1
