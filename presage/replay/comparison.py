"""Compares two sets of answers to the same scans."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from common.geometry import se2
from common.messages.definitions import Belief, CmdVel, Stamped
from services.recorder.files.message_counts import Sequence

BIT_FOR_BIT = "state, pose, covariance, free energy"
# Beliefs that both call tracking, where equality is not required:
TOLERANCE_M, TOLERANCE_RAD = 0.01, 0.01


def same_belief(a: Belief, b: Belief) -> bool:
    """Whether pose, covariance and free energy are the same to the last bit."""
    covariances = [None if c is None else c.tobytes() for c in (a.covariance, b.covariance)]
    return (
        a.pose == b.pose
        and covariances[0] == covariances[1]
        and a.free_energy.hex() == b.free_energy.hex()
        and a.state == b.state
    )


@dataclass
class Pairs:
    """Recorded and new messages of one kind; the k-th of a stamp belongs to the k-th of that stamp."""

    compared: int = 0
    equal: int = 0
    position_m: list[float] = field(default_factory=list)  # differences, of beliefs
    heading_rad: list[float] = field(default_factory=list)
    tracking: list[bool] = field(default_factory=list)  # both say so
    new_tracking: int = 0  # beliefs of now that say so
    speed_most: float = 0.0  # m/s and rad/s, of commands
    _waiting: dict[int, deque[tuple[bool, Stamped]]] = field(default_factory=lambda: defaultdict(deque))

    def recorded(self, message: Stamped) -> None:
        """One of the recording."""
        self._match(message, new=False)

    def new(self, message: Stamped) -> None:
        """One of now."""
        self.new_tracking += isinstance(message, Belief) and message.state == "tracking"
        self._match(message, new=True)

    def unmatched(self) -> Counter[str]:
        """How many wait for their other half: ``recorded`` without a new one, ``new`` without a recorded one."""
        left = [new for queue in self._waiting.values() for new, _ in queue]
        return Counter({"recorded": left.count(False), "new": left.count(True)})

    def _match(self, message: Stamped, *, new: bool) -> None:
        queue = self._waiting[message.stamp_ns]
        if not queue or queue[0][0] == new:
            queue.append((new, message))
            return
        _, other = queue.popleft()
        if not queue:
            del self._waiting[message.stamp_ns]
        self.compared += 1
        if isinstance(message, Belief) and isinstance(other, Belief):
            self._beliefs(message, other)
        elif isinstance(message, CmdVel) and isinstance(other, CmdVel):
            self.equal += message.twist == other.twist
            self.speed_most = max(self.speed_most, float(np.abs(message.twist.array() - other.twist.array()).max()))

    def _beliefs(self, a: Belief, b: Belief) -> None:
        self.equal += same_belief(a, b)
        away = a.pose.array() - b.pose.array()
        self.position_m.append(float(np.hypot(*away[:2])))
        self.heading_rad.append(abs(float(se2.wrap(away[2]))))
        self.tracking.append(a.state == b.state == "tracking")

    def as_dict(self) -> dict[str, Any]:
        """Plain names, units in them; None where nothing was compared."""
        both = np.array(self.tracking, bool)
        where, turned = np.array(self.position_m), np.array(self.heading_rad)

        def of(statistic: Any, values: Any) -> float | None:
            return float(statistic(values)) if len(values) else None

        left = self.unmatched()
        return {
            "compared": self.compared, "equal": self.equal,
            "recorded_without_new": left["recorded"], "new_without_recorded": left["new"],
            "position_difference_median_m": of(np.median, where), "position_difference_max_m": of(np.max, where),
            "heading_difference_max_rad": of(np.max, turned),
            "both_tracking": int(both.sum()),
            "position_difference_tracking_max_m": of(np.max, where[both] if len(both) else where),
            "heading_difference_tracking_max_rad": of(np.max, turned[both] if len(both) else turned),
        }  # fmt: skip


@dataclass
class Outcome:
    """What it came to."""

    imported: bool = field(default=False, kw_only=True)  # from a log, which holds no beliefs to compare with
    lockstep: bool  # the session ran so, and runs so again: equality is required
    why: str = ""  # it is not
    beliefs: Pairs = field(default_factory=Pairs)
    commands: Pairs = field(default_factory=Pairs)
    scans: int = 0  # in the recording
    numbers: Sequence = field(default_factory=Sequence)  # of all recorded scans
    given: int = 0
    left_out: int = 0  # never answered live
    unanswered: int = 0  # now
    goals_placed: bool = True  # between the beliefs where the controller took them
    notes: list[str] = field(default_factory=list)
    damaged: str = ""  # what kept the recording from being read to its end

    @property
    def good(self) -> bool:
        """Equal bit for bit; where the session did not run in lockstep, within the tolerance once tracking.

        Of an imported log: every scan was answered.
        """
        pairs, left = self.beliefs, self.beliefs.unmatched()["recorded"]
        if self.damaged:
            return False
        if self.imported:
            return self.given > self.unanswered == 0
        if self.lockstep:
            driven = self.commands.compared == self.commands.equal or not self.goals_placed
            return 0 < pairs.compared == pairs.equal and not left and driven
        numbers = pairs.as_dict()
        most_m, most_rad = (
            numbers[f"{what}_difference_tracking_max_{unit}"] for what, unit in (("position", "m"), ("heading", "rad"))
        )
        return pairs.compared > 0 and (most_m or 0.0) <= TOLERANCE_M and (most_rad or 0.0) <= TOLERANCE_RAD

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "imported": self.imported, "tracking": self.beliefs.new_tracking,
            "lockstep": self.lockstep, "why_not": self.why, "good": self.good, "damaged": self.damaged,
            "scans": self.scans, "scans_left_out": self.left_out,
            "scans_unanswered": self.unanswered, "beliefs": self.beliefs.as_dict(),
            "commands": {
                "compared": self.commands.compared, "equal": self.commands.equal,
                "difference_max_m_s": self.commands.speed_most,
            },
            "tolerance_m": 0.0 if self.lockstep else TOLERANCE_M,
            "tolerance_rad": 0.0 if self.lockstep else TOLERANCE_RAD,
            "notes": self.notes,
        }  # fmt: skip
