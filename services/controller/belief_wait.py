"""What the controller waits for before it answers a belief with a command.

To process a belief means to wait for predicted scans if the policy needs them, and otherwise to answer it at once.

| state | new belief | scan | predicted scans | deadline |
|---|---|---|---|---|
| NoBelief | process it | answer the scan, if the robot is driven by hand or still moves | - | - |
| Answered | process it | - | - | stop the robot: NoBelief |
| AwaitsScan | process the waiting one, then the new one | process, if it is not older | - | process |
| AwaitsPredictions | process it in place of the waiting one | - | answer | stop the robot: NoBelief |

The network may deliver a belief before its scan. Such a belief enters AwaitsScan instead of being processed; a belief
that awaits predictions is answered first. A repeated belief changes nothing; if it was answered, it gets the same
answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from common.messages.definitions import Belief


@dataclass(frozen=True)
class NoBelief:
    """No belief has come yet, or none within `belief_timeout`. The robot stops, or is driven by hand."""


@dataclass(frozen=True)
class Answered:
    """The latest belief was answered."""


@dataclass(frozen=True)
class AwaitsScan:
    """A belief waits for its scan."""

    belief: Belief
    deadline_s: float  # time.monotonic() at which it is answered without the scan


@dataclass(frozen=True)
class AwaitsPredictions:
    """A belief waits for the scans that the estimator predicts at possible destinations."""

    belief: Belief
    cpu_ns: int  # CPU time of preparing the request, which counts as part of the step


BeliefWait = NoBelief | Answered | AwaitsScan | AwaitsPredictions
