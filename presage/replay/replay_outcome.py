"""Compares recorded and new outputs for the same scans."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from common.geometry import se2
from common.messages.definitions import Belief, CmdVel, Stamped
from services.recorder.files.message_counts import SequenceNumbers

COMPARED_FIELDS = "state, pose, covariance, free energy"
# Maximum difference of beliefs that are both in state tracking, if equality is not required:
TOLERANCE_M, TOLERANCE_RAD = 0.01, 0.01


def same_belief(a: Belief, b: Belief) -> bool:
    """Whether state, pose, covariance and free energy are identical to the last bit."""
    covariances = [None if c is None else c.tobytes() for c in (a.covariance, b.covariance)]
    return (
        a.pose == b.pose
        and covariances[0] == covariances[1]
        and repr(a.free_energy) == repr(b.free_energy)
        and a.state == b.state
    )


@dataclass
class MessagePairs:
    """Compares recorded and new messages of one type. Messages with the same stamp are paired in their order."""

    compared: int = 0
    equal: int = 0
    position_m: list[float] = field(default_factory=list)  # differences between beliefs
    heading_rad: list[float] = field(default_factory=list)
    tracking: list[bool] = field(default_factory=list)  # whether both beliefs are in state tracking
    max_speed_difference: float = 0.0  # m/s or rad/s, between commands
    # Messages without their counterpart, by stamp: (whether new, message).
    _unpaired: dict[int, deque[tuple[bool, Stamped]]] = field(default_factory=lambda: defaultdict(deque))

    def add_recorded(self, message: Stamped) -> None:
        """Adds a message of the recording."""
        self._match(message, new=False)

    def add_new(self, message: Stamped) -> None:
        """Adds a new message."""
        self._match(message, new=True)

    def unmatched(self) -> Counter[str]:
        """Number of messages without a counterpart: ``recorded`` without a new one, ``new`` without a recorded one."""
        left = [new for queue in self._unpaired.values() for new, _ in queue]
        return Counter({"recorded": left.count(False), "new": left.count(True)})

    def _match(self, message: Stamped, *, new: bool) -> None:
        queue = self._unpaired[message.stamp_ns]
        if not queue or queue[0][0] == new:
            queue.append((new, message))
            return
        _, other = queue.popleft()
        if not queue:
            del self._unpaired[message.stamp_ns]
        self.compared += 1
        if isinstance(message, Belief) and isinstance(other, Belief):
            self._compare_beliefs(message, other)
        elif isinstance(message, CmdVel) and isinstance(other, CmdVel):
            self.equal += message.twist == other.twist
            difference = float(np.abs(message.twist.array() - other.twist.array()).max())
            self.max_speed_difference = max(self.max_speed_difference, difference)

    def _compare_beliefs(self, a: Belief, b: Belief) -> None:
        self.equal += same_belief(a, b)
        difference = a.pose.array() - b.pose.array()
        self.position_m.append(float(np.hypot(*difference[:2])))
        self.heading_rad.append(abs(float(se2.wrap(difference[2]))))
        self.tracking.append(a.state == b.state == "tracking")

    def as_dict(self) -> dict[str, Any]:
        """The results by names that contain their unit. A statistic is None if nothing was compared."""
        both = np.array(self.tracking, bool)
        position, heading = np.array(self.position_m), np.array(self.heading_rad)

        def reduce(statistic: Any, values: Any) -> float | None:
            return float(statistic(values)) if len(values) else None

        left = self.unmatched()
        return {
            "compared": self.compared,
            "equal": self.equal,
            "recorded_without_new": left["recorded"],
            "new_without_recorded": left["new"],
            "position_difference_median_m": reduce(np.median, position),
            "position_difference_max_m": reduce(np.max, position),
            "heading_difference_max_rad": reduce(np.max, heading),
            "both_tracking": int(both.sum()),
            "position_difference_tracking_max_m": reduce(np.max, position[both] if len(both) else position),
            "heading_difference_tracking_max_rad": reduce(np.max, heading[both] if len(both) else heading),
        }


@dataclass
class ReplayOutcome:
    """Result of running services on recorded inputs."""

    lockstep: bool  # the session and the replay ran in lockstep, so that equality is required
    tolerance_reason: str = ""  # why results may differ by the tolerance; empty if they must be identical
    beliefs: MessagePairs = field(default_factory=MessagePairs)
    commands: MessagePairs = field(default_factory=MessagePairs)
    scans: int = 0  # in the recording
    numbers: SequenceNumbers = field(default_factory=SequenceNumbers)  # sequence numbers of all recorded scans
    sent: int = 0  # scans sent to the services
    left_out: int = 0  # scans without a recorded belief, which were not sent
    unanswered: int = 0  # scans sent, but without a new belief
    goals_placed: bool = True  # whether each goal was sent after the same belief as in the session
    notes: list[str] = field(default_factory=list)
    damaged: str = ""  # why the recording could not be read to its end

    @property
    def agrees(self) -> bool:
        """Whether the results agree.

        In lockstep they must be identical; otherwise they may differ by the tolerance while tracking.
        """
        pairs, left = self.beliefs, self.beliefs.unmatched()["recorded"]
        if self.damaged:
            return False
        if self.lockstep:
            commands_agree = self.commands.compared == self.commands.equal or not self.goals_placed
            return 0 < pairs.compared == pairs.equal and not left and commands_agree
        differences = pairs.as_dict()
        position_m = differences["position_difference_tracking_max_m"] or 0.0
        heading_rad = differences["heading_difference_tracking_max_rad"] or 0.0
        return bool(pairs.compared > 0 and position_m <= TOLERANCE_M and heading_rad <= TOLERANCE_RAD)

    def as_dict(self) -> dict[str, Any]:
        """The results as values that JSON can hold."""
        return {
            "lockstep": self.lockstep,
            "tolerance_reason": self.tolerance_reason,
            "agrees": self.agrees,
            "damaged": self.damaged,
            "scans": self.scans,
            "scans_left_out": self.left_out,
            "scans_unanswered": self.unanswered,
            "beliefs": self.beliefs.as_dict(),
            "commands": {
                "compared": self.commands.compared,
                "equal": self.commands.equal,
                "difference_max_m_s": self.commands.max_speed_difference,
            },
            "tolerance_m": 0.0 if self.lockstep else TOLERANCE_M,
            "tolerance_rad": 0.0 if self.lockstep else TOLERANCE_RAD,
            "notes": self.notes,
        }
