"""Infers after which belief each goal was accepted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from common.messages.definitions import CmdVel, Stamped, Status


class GoalTimes:
    """Infers from the statuses and commands of a controller when it accepted each goal.

    For a belief, the controller publishes a status and a command with its stamp; for a goal, only a status, with the
    stamp of the last belief. A status without a command therefore is an accepted goal.
    """

    def __init__(self) -> None:
        self._surplus: Counter[int] = Counter()  # number of statuses minus commands, by stamp
        self._first: Status | None = None
        self._last = 0  # stamp of the last status

    def add(self, messages: Iterable[Stamped]) -> None:
        """Adds statuses and commands in their recorded order."""
        for message in messages:
            if isinstance(message, Status):
                self._first = self._first or message
                self._surplus[message.stamp_ns] += 1
                self._last = message.stamp_ns
            elif isinstance(message, CmdVel):
                self._surplus[message.stamp_ns] -= 1

    def accepted(self, count: int) -> Counter[int | None] | None:
        """Returns how many of ``count`` goals were accepted after each belief, by its stamp (None before the first).

        Returns None if statuses and goals do not match, because a message is missing or the recording began later.
        """
        accepted: Counter[int | None] = Counter({stamp: n for stamp, n in self._surplus.items() if n > 0})
        if sum(accepted.values()) == count + 1 and accepted[self._last]:  # the recording ended before the last command
            accepted[self._last] -= 1
        if sum(accepted.values()) != count or self._first is None:
            return None
        if self._first.goal is not None and self._first.distance is None:  # it answers a goal, not a belief
            accepted[None] = accepted.pop(self._first.stamp_ns, 0)
        return accepted
