"""Prediction error of a model on scans it has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise.gauss_newton import polish
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.scan_likelihood import ScanLikelihood

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.shared.generative_models import GenerativeModel

NOISE_DRAWS = 4  # noisy copies of each test scan


@dataclass(frozen=True)
class ModelErrors:
    """Errors of a model, as the model card states them."""

    range_error_median: float  # m
    range_error_mean: float  # m
    share_above_5_cm: float
    position_error_median: float  # m, of poses found from scans without noise
    position_error_rms: float  # m
    inflation: float  # factor on the covariance: mean normalised squared error of poses from noisy scans, at least 1


def evaluate_model(
    model: GenerativeModel,
    poses: Array,
    mount: Array,
    angles: Array,
    ranges: Array,
    range_max: float,
    sigma: float,
    relative: float = 0.0,
) -> ModelErrors:
    """Compares the model with noiseless scans ``ranges`` (N, B) m at base_link poses (N, 3).

    ``sigma`` m is the scanner's noise, and ``relative`` the part that grows with the range, as a fraction of the range.
    """
    likelihood = Likelihood(sigma, relative=relative)
    expected = model.expect(se2.compose(poses, mount), angles)
    both = np.isfinite(ranges) & np.isfinite(expected.ranges)
    range_error = np.abs(ranges[both] - expected.ranges[both])
    position_errors, nees, rng = [], [], np.random.default_rng(0)
    for pose, exact in zip(poses, ranges, strict=True):
        for draw in range(1 + NOISE_DRAWS):  # the first one without noise
            noise = likelihood.deviation(exact) * rng.standard_normal(len(exact)) if draw else 0.0
            scan = ScanLikelihood(model, likelihood, mount, angles, exact + noise, range_max)
            found, evidence = polish(scan, pose[None])
            inverse = np.linalg.inv(evidence.curvature[0] + 1e-6 * np.eye(3))
            error = se2.difference(found[0], pose) + inverse @ evidence.xi[0]  # with a last step to the minimum
            if draw:
                covariance = inverse @ (evidence.xi_noise_covariance[0] + evidence.xi_model_covariance[0]) @ inverse
                nees.append(float(error @ np.linalg.pinv(covariance, hermitian=True) @ error) / 3)
            else:
                position_errors.append(float(np.hypot(error[0], error[1])))
    return ModelErrors(
        float(np.median(range_error)),
        float(range_error.mean()),
        float((range_error > 0.05).mean()),
        float(np.median(position_errors)),
        float(np.sqrt(np.mean(np.square(position_errors)))),
        max(1.0, float(np.mean(nees))),
    )
