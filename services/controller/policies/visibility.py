"""Which cells of a grid are seen from which places, compiled by numba.

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
def visible(
    opaque: npt.NDArray[np.bool_], places: Array, targets: Array, reach: float, clear_range: float
) -> npt.NDArray[np.bool_]:
    """Whether a strip from each place to each target passes no opaque cell; (P, T) bool.

    The strip is two cells wide, so that targets at the edge of a shadow count as hidden.

    ``places`` (P, 2) and ``targets`` (T, 2) are x and y in cells from the corner of cell (0, 0) of ``opaque`` (rows,
    columns). Targets farther than ``reach`` cells are not seen. Cells nearer to the place than ``clear_range``, or
    nearer to the target than 2, do not hide it; both distances are in cells.
    """
    rows, columns = opaque.shape
    seen = np.zeros((len(places), len(targets)), np.bool_)
    for p in range(len(places)):
        for t in range(len(targets)):
            dx, dy = targets[t, 0] - places[p, 0], targets[t, 1] - places[p, 1]
            distance = np.hypot(dx, dy)
            if distance > reach:
                continue
            ux, uy = dx / distance, dy / distance
            free, at = True, clear_range
            while free and at < distance - 2.0:
                for side in (-1.0, 0.0, 1.0):
                    x, y = places[p, 0] + ux * at - side * uy, places[p, 1] + uy * at + side * ux
                    i, j = int(np.floor(y)), int(np.floor(x))
                    free = free and 0 <= i < rows and 0 <= j < columns and not opaque[i, j]
                at += 0.5
            seen[p, t] = free
    return seen
