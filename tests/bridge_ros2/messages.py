"""Messages for tests of the bridge."""

from __future__ import annotations

import numpy as np

from common.messages.definitions import Belief, BeliefHypothesis, Pose


def belief(state: str = "tracking", *, covariance: bool = True, stamp_ns: int = 2_000_000_000) -> Belief:
    matrix = np.array([[0.01, 0.002, 0.003], [0.002, 0.04, 0.005], [0.003, 0.005, 0.09]]) if covariance else None
    here, there = Pose(x=3.0, y=-1.5, yaw=0.5), Pose(x=8.0, y=2.0, yaw=-1.0)
    return Belief(
        stamp_ns=stamp_ns, state=state, pose=here, covariance=matrix, xi=np.zeros(3, np.float32), free_energy=1.0,
        accuracy=1.0, hypotheses=[
            BeliefHypothesis(pose=here, covariance=matrix, weight=0.75),
            BeliefHypothesis(pose=there, covariance=matrix, weight=0.25),
        ],
    )  # fmt: skip
