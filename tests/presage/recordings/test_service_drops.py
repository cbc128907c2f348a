"""Messages that services dropped during a recording."""

from __future__ import annotations

from common.messages.definitions import Health, TopicHealth
from presage.recordings.service_drops import ServiceDrops


def test_drops():
    """Those before the recording do not count; those of a process that started during it all count."""
    drops = ServiceDrops()
    for instance, seq, dropped in (("a", 7, 5), ("b", 0, 1), ("a", 8, 6), ("b", 1, 3), ("a", 9, 9), ("c", 4, 2)):
        row = TopicHealth(key="presage/robot/scan", dropped=dropped)
        drops.add(Health(stamp_ns=0, seq=seq, service="estimator", uptime=1.0, topics=[row], instance=instance))
    assert drops.counts() == {("estimator", "presage/robot/scan"): (9 - 5) + 3}
