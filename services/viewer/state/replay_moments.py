"""Messages of a replay by stamp.

After a seek, a replay may stop between a scan and its belief, and the messages of one step arrive at once and in any
order. So messages are collected until none arrives for a while; then the stamp with the most messages is shown.
"""

from __future__ import annotations

from collections import OrderedDict

from common.messages.definitions import Stamped
from common.messages.topics import PLAN, SCAN, Topic

QUIET_TIME_S = 0.03  # without a message: all messages of a step have arrived
MAX_GATHERING_S = 0.06  # longest collection, for a replay that plays without a pause
MAX_STAMPS = 64

MessagesByTopic = dict[str, Stamped]  # by the topic's name


class ReplayMoments:
    """Messages of a replay that may still be shown."""

    def __init__(self) -> None:
        self._by_stamp: OrderedDict[int, MessagesByTopic] = OrderedDict()
        self._shown = (-1, 0)  # stamp last shown, and its number of messages at that time
        self._first = self._last = 0.0  # when the first and last new message arrived, s
        self._has_new = False  # messages have arrived since the last `choose`

    def add(self, topic: Topic, message: Stamped, now: float) -> None:
        """Adds a message received at time ``now`` in s."""
        self._by_stamp.setdefault(message.stamp_ns, {})[topic.name] = message
        if len(self._by_stamp) > MAX_STAMPS:
            self._by_stamp.popitem(last=False)
        self._first = self._first if self._has_new else now
        self._last, self._has_new = now, True

    def due(self, now: float) -> float | None:
        """Seconds until `choose` should be called. Returns None if there is no new message."""
        return min(self._last + QUIET_TIME_S, self._first + MAX_GATHERING_S) - now if self._has_new else None

    def choose(self) -> MessagesByTopic | None:
        """Messages of the stamp with the most messages among those not yet shown; the newest stamp if several match.

        Plans are not counted, because a standing robot has none. Older stamps are removed. Returns None if there is
        nothing new to show.
        """
        self._has_new = False
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
        """Removes all messages, after stamps went back."""
        self._by_stamp.clear()
        self._shown, self._has_new = (-1, 0), False

    def _is_new(self, stamp: int, count: int) -> bool:
        shown_stamp, shown_count = self._shown
        return stamp > shown_stamp or (stamp == shown_stamp and count > shown_count)
