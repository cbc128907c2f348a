"""Information matrices of planar poses."""

from __future__ import annotations

import numpy as np

from common.geometry.se2 import Array


def subtract_spurious(information: Array, spurious: Array) -> Array:
    """The ``information`` (3, 3) minus the ``spurious`` part of it (3, 3), but nowhere less than 0.

    Their ratio is limited to 1 along the directions in which both are diagonal, so units do not matter.
    """
    unit = np.sqrt(np.diag(information))
    unit[unit == 0] = 1.0
    units = np.outer(unit, unit)
    root = np.linalg.cholesky(information / units + 1e-6 * np.eye(3))  # which exists without information too
    inverse = np.linalg.inv(root)
    kept, directions = np.linalg.eigh(inverse @ ((information - spurious) / units) @ inverse.T)
    half = root @ directions * np.sqrt(np.maximum(kept, 0.0))
    return np.asarray(half @ half.T * units)
