"""Observation, Posterior, Hypothesis and the Estimator protocol."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array

State = Literal["localising", "tracking", "ambiguous", "lost"]


@dataclass(frozen=True)
class Observation:
    """One scan, and what else is known of the motion that led to it."""

    ranges: Array  # (B,) m; +inf nothing within range_max, -inf says nothing (common/robot/ranges.py)
    angles: Array  # (B,) rad in laser
    range_max: float  # m
    stamp: float | None = None  # s, of the measurement; None: no clock, scans count
    odom: Array | None = None  # (3,) base_link in odom at the stamp
    command: Array | None = None  # (3,) m/s, m/s, rad/s in base_link: the last velocity command
    goal: Array | None = None  # (3,) base_link in map that is preferred; only the paper's equation 3 has a use for it


@dataclass(frozen=True)
class Hypothesis:
    """One Gaussian of a mixture."""

    pose: Array  # (3,) base_link in map
    covariance: Array | None  # (3, 3) of x, y, yaw in map; None: this estimator has none
    weight: float  # of the mixture, sums to 1


@dataclass(frozen=True)
class Posterior:
    """The belief after a scan; the best hypothesis first."""

    state: State
    hypotheses: tuple[Hypothesis, ...]
    accuracy: float  # nats, -ln p(o | pose), over the best hypothesis
    complexity: float  # nats, how far the posterior is from the prior
    xi: Array  # (3,) minus the gradient of accuracy at the pose, in map
    curvature: Array  # (3, 3) Gauss-Newton Hessian of accuracy, in map
    predicted: Array  # (B,) m expected at the pose
    sigma: Array = field(default_factory=lambda: np.zeros(0))  # (B,) m, its stated standard deviation; empty: none

    @property
    def pose(self) -> Array:
        """(3,) base_link in map, of the best hypothesis."""
        return self.hypotheses[0].pose

    @property
    def covariance(self) -> Array | None:
        """(3, 3) of the best hypothesis; None where the estimator has none."""
        return self.hypotheses[0].covariance

    @property
    def free_energy(self) -> float:
        """Nats: accuracy + complexity."""
        return self.accuracy + self.complexity


@dataclass(frozen=True)
class Predicted:
    """The scans expected from N poses along B beams."""

    ranges: Array  # (N, B) m; +inf: no return expected
    sigma: Array  # (N, B) m, their stated standard deviation


class Estimator(Protocol):
    """Perception, whatever its method."""

    name: str

    def update(self, observation: Observation) -> Posterior:
        """The posterior after one more scan."""
        ...

    def predict(self, poses: Array, angles: Array) -> Predicted:
        """What would be seen from base_link poses (N, 3) in map along beams at ``angles`` (B,) rad in laser.

        Wherever the poses are, inside walls too; the belief does not change. Raises UserError where the model cannot
        predict such poses or beams.
        """
        ...

    def restart(self, pose: Array | None = None, covariance: Array | None = None) -> None:
        """Begin anew: near ``pose`` (3,) with ``covariance`` (3, 3), or knowing nothing."""
        ...
