"""Messages of a replay by stamp.

A replay that is scrubbed stops between a scan and its belief, and a step's messages come at once, in whatever order
the network brings them. So they are gathered until it is quiet, and then the fullest moment is shown.
"""

from __future__ import annotations

from collections import OrderedDict

from common.messages.definitions import Stamped
from common.messages.topics import PLAN, SCAN, Topic

QUIET_TIME_S = 0.03  # s without a message: what was sent has come
MAX_GATHERING_S = 0.06  # s, of one that plays on without a pause
MAX_STAMPS = 64  # stamps

MessagesByTopic = dict[str, Stamped]  # by topic's name


class ReplayMoments:
    """Those that may still be shown."""

    def __init__(self) -> None:
        """None."""
        self._by_stamp: OrderedDict[int, MessagesByTopic] = OrderedDict()
        self._shown = (-1, 0)  # stamp, and how many messages it had
        self._first = self._last = 0.0  # s, when messages came that nobody looked at yet
        self._news = False

    def take(self, topic: Topic, message: Stamped, at: float) -> None:
        """Add a message."""
        self._by_stamp.setdefault(message.stamp_ns, {})[topic.name] = message
        if len(self._by_stamp) > MAX_STAMPS:
            self._by_stamp.popitem(last=False)
        self._first = self._first if self._news else at
        self._last, self._news = at, True

    def due(self, at: float) -> float | None:
        """Seconds until `choose` may be asked; None: nothing came."""
        return min(self._last + QUIET_TIME_S, self._first + MAX_GATHERING_S) - at if self._news else None

    def choose(self) -> MessagesByTopic | None:
        """The fullest of those not shown as they are, of several the newest; what is older is forgotten.

        A plan does not count: where the robot stands there is none.
        """
        self._news = False
        stamp, count = max(
            ((s, len(m)) for s, m in self._by_stamp.items() if SCAN.name in m and self._is_new(s, len(m))),
            key=lambda moment: (moment[1] - (PLAN.name in self._by_stamp[moment[0]]), moment[0]),
            default=self._shown,
        )
        if (stamp, count) == self._shown:
            return None
        self._shown = (stamp, count)
        for old in [s for s in self._by_stamp if s < stamp]:
            del self._by_stamp[old]
        return self._by_stamp[stamp]

    def clear(self) -> None:
        """Time went back."""
        self._by_stamp.clear()
        self._shown, self._news = (-1, 0), False

    def _is_new(self, stamp: int, count: int) -> bool:
        shown, had = self._shown
        return stamp > shown or (stamp == shown and count > had)
