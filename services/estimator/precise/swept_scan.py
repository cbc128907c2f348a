"""Allows for the robot's acceleration while a scan is measured, beam after beam.

A scan is first corrected for the mean motion since the last one (`motion_correction`), as if the robot did not
accelerate. It may have accelerated by a between the middle of the last sweep and the first beam, and by b during the
sweep. Let s be the time of a beam after the middle of the sweep, the first at s = -m, and T > m the time between the
middles of both sweeps. Then the pose of the robot at that beam differs from that of the correction by

    a s (T - m)² / (2 T)  +  b (s² + 2 s m - s m² / T) / 2

For s = -m, this is the error of the pose at the stamp. Both accelerations are unknown, with the variance of a uniform
distribution within the limits of the base. They are estimated together with the pose: the derivative of a range by an
acceleration is that by the pose, times the factor of the acceleration above. The evidence for the pose alone follows by
marginalisation (Schur complement). All this is to first order, so the scan is corrected again for the accelerations
found. In a curve, the base also accelerates across its direction of motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING

import numpy as np

from common.geometry import se2
from services.estimator.precise.likelihood import Evidence

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.motion_model import MotionNoise
    from services.estimator.precise.scan_likelihood import ScanLikelihood


@dataclass(frozen=True)
class Displacement:
    """The pose at the stamp, relative to that in the middle of the sweep."""

    mean: Array  # (3,) m, m, rad in map
    jacobian: Array  # (3, 3) derivative by the pose in the middle of the sweep, of the part due to accelerations
    covariance: Array  # (3, 3) in map, if that pose was known exactly

    def pose_at_stamp(self, pose: Array) -> Array:
        """The pose (3,) at the stamp, from that in the middle of the sweep."""
        x, y, yaw = pose + self.mean
        return np.array([x, y, float(se2.wrap(yaw))])

    def covariance_at_stamp(self, covariance: Array) -> Array:
        """Covariance (3, 3) of the pose at the stamp, from that of the pose in the middle of the sweep."""
        jacobian = np.eye(3) + self.jacobian
        return np.asarray(jacobian @ covariance @ jacobian.T + self.covariance)


def acceleration_factors(times: Array, period: float) -> Array:
    """The factors (2, B) in s² of both accelerations for beams at ``times`` (B,) s after the middle of the sweep."""
    s, m, T = times, float(-times.min()), period
    return np.array([s * (T - m) ** 2 / (2 * T), (s**2 + 2 * s * m - s * m**2 / T) / 2])


def acceleration_limits(noise: MotionNoise, times: Array, period: float) -> Array:
    """The limits (2, 3) of both accelerations in base_link, m/s², m/s² and rad/s²; arguments as above.

    In a long time before the sweep, the base cannot accelerate by more than from full speed backwards to forwards.
    """
    acceleration = noise.acceleration
    across = max(acceleration, noise.speed * noise.turn)
    during = np.array([acceleration, across, noise.turn_acceleration])
    return np.array([np.minimum(during, 2 * noise.full_speed / (period + float(times.min()))), during])


@dataclass(frozen=True)
class SweptEvidence:
    """The evidence of a swept scan for pose and accelerations together: x, y, yaw, and the same of a and b, in map."""

    poses: Array  # (N, 3) in the middle of the sweep, where this evidence was computed
    joint: Evidence  # by all nine unknowns: xi (N, 9) of scan and prior, matrices (N, 9, 9) of the scan alone
    prior: Array  # (N, 6, 6) information of the accelerations before the scan
    at_stamp: Array  # (3, 6) the pose's displacement at the stamp, per acceleration: s²
    assumed: Array  # (6,) accelerations in map for which the scan was corrected

    @classmethod
    def from_scan(
        cls, scan: ScanLikelihood, poses: Array, limits: Array, period: float, assumed: Array
    ) -> SweptEvidence:
        """The evidence at ``poses`` (N, 3) of a scan that was corrected to the middle of its sweep.

        It was also corrected for the ``assumed`` accelerations (6,) in map. ``limits`` (2, 3) are those in base_link,
        and ``period`` s is the time since the last scan.
        """
        factors = np.array([np.ones_like(scan.times), *acceleration_factors(scan.times, period)])
        weights = scan.surface_evidence(poses).weights
        products = {
            (i, j): scan.evidence(poses, 0.0, weights * factors[i] * factors[j])
            for i, j in combinations_with_replacement(range(len(factors)), 2)
        }
        parts = [[products[min(i, j), max(i, j)] for j in range(len(factors))] for i in range(len(factors))]

        def matrix(name: str) -> Array:
            return np.block([[getattr(part, name) for part in row] for row in parts])

        joint = Evidence(
            parts[0][0].accuracy,
            np.concatenate([part.xi for part in parts[0]], axis=1),
            *(matrix(name) for name in ("curvature", "xi_noise_covariance", "xi_model_covariance")),
        )
        to_map = np.array([se2.rotation(float(yaw)) for yaw in poses[:, 2]])
        prior = np.zeros((len(poses), 6, 6))
        for row, part in zip(limits, (slice(3), slice(3, 6)), strict=True):
            prior[:, part, part] = to_map @ np.diag(3 / row**2) @ to_map.transpose(0, 2, 1)
        joint.xi[:, 3:] -= prior @ assumed
        at_stamp = np.kron(factors[1:, int(np.argmin(scan.times))], np.eye(3))
        return cls(poses, joint, prior, at_stamp, assumed)

    def of_pose(self) -> Evidence:
        """The evidence (N,) for the pose alone."""
        curvature = self.joint.curvature
        gain = -curvature[:, :3, 3:] @ np.linalg.inv(curvature[:, 3:, 3:] + self.prior)
        project = np.concatenate([np.tile(np.eye(3), (len(gain), 1, 1)), gain], axis=2)
        transposed = project.transpose(0, 2, 1)
        of_prior = gain @ self.prior @ gain.transpose(0, 2, 1)
        return Evidence(
            self.joint.accuracy,
            (project @ self.joint.xi[..., None])[..., 0],
            project @ curvature @ transposed + of_prior,
            project @ self.joint.xi_noise_covariance @ transposed + of_prior,
            project @ self.joint.xi_model_covariance @ transposed,
        )

    def accelerations(self, k: int) -> Array:
        """The most probable accelerations (6,) in map at the k-th of the poses."""
        return self.assumed + np.linalg.solve(self.joint.curvature[k, 3:, 3:] + self.prior[k], self.joint.xi[k, 3:])

    def displacement(self, k: int, pose: Array, interpolated: Array) -> Displacement:
        """The displacement at the stamp, if ``pose`` (3,) is that of the k-th hypothesis in the middle of the sweep.

        ``interpolated`` (3,) is the pose at the stamp if the robot did not accelerate.
        """
        covariance = np.linalg.inv(self.joint.curvature[k, 3:, 3:] + self.prior[k])
        jacobian = -covariance @ self.joint.curvature[k, 3:, :3]
        accelerations = self.accelerations(k) + jacobian @ se2.difference(pose, self.poses[k])
        return Displacement(
            se2.difference(interpolated, pose) + self.at_stamp @ accelerations,
            self.at_stamp @ jacobian,
            self.at_stamp @ covariance @ self.at_stamp.T,
        )
