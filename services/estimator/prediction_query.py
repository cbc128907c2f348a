"""Answers the query `predict`: scans expected from given poses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.errors import UserError
from common.messages.requests import PredictReply, PredictRequest

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.shared.interface import PoseEstimator

MAX_POSES = 1000
MAX_RANGES = 1_000_000  # take about half a second, during which no scan is processed


def answer_prediction(
    estimator: PoseEstimator, request: PredictRequest, angles: Array, range_max: float
) -> PredictReply:
    """Predicts scans of a scanner with beams at ``angles`` (B,) rad; ranges beyond ``range_max`` m become +inf.

    Raises UserError if the request is too large, or the model cannot predict the poses.
    """
    beams = min(request.beams or len(angles), len(angles))
    chosen = angles[np.round(np.linspace(0, len(angles) - 1, beams)).astype(np.intp)]
    count = len(request.poses)
    if count > MAX_POSES:
        raise UserError(f"{count} poses are too many to predict at once: request at most {MAX_POSES}")
    if count * len(chosen) > MAX_RANGES:
        raise UserError(
            f"{count} poses with {len(chosen)} beams each are too many to predict at once: request fewer poses or "
            f"beams: at most {MAX_RANGES} ranges"
        )
    if not count:
        return PredictReply(angles=chosen.astype(np.float32))
    found = estimator.predict(request.poses, chosen)
    ranges = np.where(found.ranges > range_max, np.inf, found.ranges)
    return PredictReply(
        angles=chosen.astype(np.float32),
        ranges=ranges.ravel().astype(np.float32),
        sigma=found.sigma.ravel().astype(np.float32),
    )
