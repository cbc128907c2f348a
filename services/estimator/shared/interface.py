"""The interface of pose estimators: the PoseEstimator protocol, and the types of its arguments and results."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

import numpy as np

from common.geometry import se2

if TYPE_CHECKING:
    from common.geometry.se2 import Array

State = Literal["localising", "tracking", "ambiguous", "lost"]


@dataclass(frozen=True)
class Observation:
    """One scan, and other information about the motion since the last scan."""

    ranges: Array  # (B,) m, not 0; +inf: no return within range_max, -inf: not measured (common/robot/ranges.py)
    angles: Array  # (B,) rad in laser
    range_max: float  # m
    stamp: float | None = None  # s, time of the measurement; None if unknown: scans then come at a nominal rate
    odom: Array | None = None  # (3,) base_link in odom at the stamp
    command: Array | None = None  # (3,) the last velocity command: m/s, m/s, rad/s in base_link
    goal: Array | None = None  # (3,) preferred pose, base_link in map; used only by the paper's equation 3
    time_increment: float = field(default=0.0, kw_only=True)  # s between beams, as in a scan message

    def is_earlier_than(self, stamp: float | None) -> bool:
        """Whether this scan is earlier than the last one, which had the ``stamp`` in s, as when a replay starts again.

        Then the duration of the motion in between is unknown.
        """
        return self.stamp is not None and stamp is not None and self.stamp < stamp

    def period_since(self, stamp: float | None, nominal: float) -> float:
        """Time in s since the last scan, which had the ``stamp`` in s; ``nominal`` if it is unknown or not positive."""
        if stamp is None or self.stamp is None or self.stamp <= stamp:
            return nominal
        return self.stamp - stamp

    def odometry_since(self, odom: Array | None) -> Array | None:
        """Motion (3,) in base_link by odometry since ``odom`` (3,), that of the last scan; None if one is unknown."""
        return None if self.odom is None or odom is None else se2.between(odom, self.odom)


def start_belief(pose: Array, covariance: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of a belief near ``pose``: a pose (3,), or a position (2,) of unknown heading."""
    if len(pose) == 3:
        return np.asarray(pose, float), np.asarray(covariance, float)
    spread = np.diag([0.0, 0.0, np.pi**2 / 3])
    spread[:2, :2] = np.asarray(covariance)[:2, :2]
    return np.array([*pose, 0.0]), spread


@dataclass(frozen=True)
class Hypothesis:
    """One Gaussian of the posterior, which is a mixture."""

    pose: Array  # (3,) base_link in map
    covariance: Array | None  # (3, 3) of x, y, yaw in map; None if the estimator has no covariance
    weight: float  # weights of a mixture sum to 1


@dataclass(frozen=True)
class Posterior:
    """The belief after a scan."""

    state: State
    hypotheses: tuple[Hypothesis, ...]  # best first
    accuracy: float  # nats, -ln p(o | pose) at the best hypothesis
    complexity: float  # nats, Kullback-Leibler divergence of the posterior from the prior
    xi: Array  # (3,) minus the gradient of accuracy at the pose, in map
    curvature: Array  # (3, 3) Gauss-Newton Hessian of accuracy, in map
    predicted: Array  # (B,) m, ranges expected at the pose
    # (B,) m, standard deviations of the predicted ranges; empty if the estimator does not compute them
    sigma: Array = field(default_factory=lambda: np.zeros(0))
    # Probability that the pose is within 0.2 m and 5 degrees of the truth; None if the estimator does not compute it.
    probability: float | None = None
    # Protection level (3,): errors along x and y of base_link (m) and of yaw (rad) that are exceeded in one of 10^4
    # scans; None if the estimator does not compute it.
    protection: Array | None = None

    @property
    def pose(self) -> Array:
        """Pose (3,) of the best hypothesis, base_link in map."""
        return self.hypotheses[0].pose

    @property
    def covariance(self) -> Array | None:
        """Covariance (3, 3) of the best hypothesis; None if the estimator has no covariance."""
        return self.hypotheses[0].covariance

    @property
    def free_energy(self) -> float:
        """Free energy in nats: accuracy + complexity."""
        return self.accuracy + self.complexity


@dataclass(frozen=True)
class Predicted:
    """Scans predicted at N poses along B beams."""

    ranges: Array  # (N, B) m; +inf if no return is expected
    sigma: Array  # (N, B) m, standard deviation of the ranges


class PoseEstimator(Protocol):
    """Estimates the pose of one robot from its scans."""

    name: str

    def update(self, observation: Observation) -> Posterior:
        """Returns the posterior after one more scan."""
        ...

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """Predicts scans at base_link poses (N, 3) in map, along beams at ``angles`` (B,) rad in the laser frame.

        The poses may be anywhere, also inside walls. The belief does not change. Raises UserError if the model cannot
        predict such poses or beams.
        """
        ...

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Discards the belief, and starts near ``pose`` (3,) with ``covariance`` (3, 3), or from an unknown pose.

        A ``pose`` (2,) is a position with an unknown heading.
        """
        ...


@runtime_checkable
class SearchingEstimator(Protocol):
    """An estimator whose searches can run in another thread; `update` is `track`, then `search` if it is needed.

    While a search runs, no other method may be called.
    """

    def track(self, observation: Observation) -> Posterior | None:
        """Returns the posterior after one more scan, or None if the caller has to call `search` for it."""
        ...

    def search(self) -> Posterior:
        """Searches for the scan last given to `track`, and returns the posterior."""
        ...
