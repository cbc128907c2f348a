"""Refines the poses of a drive: learns the field from its scans, matches the scans to the field, and repeats.

Mapping registers each scan to a few others. Here it is compared with all surfaces that any scan saw, so that errors
which differ from scan to scan average out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from common.geometry.se2 import Array
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.field_learning import Recipe, learn_field, seen_cells
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.precise.likelihood import Likelihood
from services.estimator.precise.noise import estimate_noise
from services.estimator.precise.scan_likelihood import ScanLikelihood
from services.mapper.slam.trajectory import distribute_corrections

ROUNDS = 4  # of learning the field and matching the scans to it
RECIPE = Recipe(resolution=0.05, sweeps=1)
PERIOD_S = 0.2  # between scans that are matched to the field; the poses between them are interpolated
PRIOR = np.array([0.01, 0.01, 0.005])  # m, m, rad: standard deviations of the corrections in one round


def refine_poses(drive: ReferenceDrive, report: Callable[[float], None]) -> Array:
    """Refines the poses (N, 3) of a drive, which may be wrong by some centimetres; reports the share that is done.

    In each round, the pose of a scan takes one Gauss-Newton step; its position along a plain wall hardly changes.
    """
    _, numbers = np.unique(np.round((drive.stamps - drive.stamps[0]) / PERIOD_S), return_index=True)
    part, likelihood = drive.part(numbers), Likelihood(estimate_noise(drive.ranges, drive.angles))
    for number in range(ROUNDS):
        report(number / ROUNDS)
        beams = Beams.of(part.poses, part.mount, part.angles, part.ranges)
        model = FieldModel(learn_field(beams, RECIPE), seen=seen_cells(beams))
        poses = [
            _take_step(ScanLikelihood(model, likelihood, part.mount, part.angles, ranges, part.range_max), pose)
            for pose, ranges in zip(part.poses, part.ranges, strict=True)
        ]
        part = replace(part, poses=np.array(poses))
    return distribute_corrections(drive.poses, numbers, part.poses, np.zeros(len(numbers), int))


def _take_step(scan: ScanLikelihood, pose: Array) -> Array:
    """The pose (3,) after a step towards where the model explains the scan best."""
    evidence = scan.evidence(pose[None])
    return np.asarray(pose + np.linalg.solve(evidence.curvature[0] + np.diag(PRIOR**-2.0), evidence.xi[0]))
