"""Between which beliefs each goal was accepted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from common.messages.definitions import CmdVel, Stamped, Status


class Goals:
    """Gathers statuses and commands of one controller, in order.

    A belief is answered by a status and a command of its stamp, a goal by a status alone, of the last belief's stamp.
    """

    def __init__(self) -> None:
        """Nothing seen."""
        self._surplus: Counter[int] = Counter()  # statuses less commands, by stamp
        self._first: Status | None = None
        self._last = 0

    def see(self, messages: Iterable[Stamped]) -> None:
        """All of a recording's."""
        for message in messages:
            if isinstance(message, Status):
                self._first = self._first or message
                self._surplus[message.stamp_ns] += 1
                self._last = message.stamp_ns
            elif isinstance(message, CmdVel):
                self._surplus[message.stamp_ns] -= 1

    def taken(self, count: int) -> Counter[int | None] | None:
        """How many of ``count`` goals were taken after the belief of each stamp (None: before the first of all).

        None where statuses and goals do not add up: a message is missing, or the recording began in between.
        """
        found: Counter[int | None] = Counter({stamp: n for stamp, n in self._surplus.items() if n > 0})
        if sum(found.values()) == count + 1 and found[self._last]:  # the recording ended between the two
            found[self._last] -= 1
        if sum(found.values()) != count or self._first is None:
            return None
        if self._first.goal is not None and self._first.distance is None:
            found[None] = found.pop(self._first.stamp_ns, 0)
        return found
