"""Counts the messages that services dropped during a recording."""

from __future__ import annotations

from collections import Counter

from common.messages.definitions import Health


class ServiceDrops:
    """Counts drops from health messages, whose counters may begin long before the recording."""

    def __init__(self) -> None:
        self.first: dict[tuple[str, str], Health] = {}  # by service and instance
        self.last: dict[tuple[str, str], Health] = {}

    def add(self, health: Health) -> None:
        """Adds a health message; the order is that of the recording."""
        process = health.service, health.instance
        self.first.setdefault(process, health)
        self.last[process] = health

    def counts(self) -> Counter[tuple[str, str]]:
        """Number of dropped messages by service and key, between the first and last health message of each process."""
        dropped = Counter[tuple[str, str]]()
        for process, health in self.last.items():
            dropped.update({(health.service, row.key): row.dropped for row in health.topics})
            first = self.first[process]
            if first.seq:  # with 0, the process started during the recording, so all of its drops count
                dropped.subtract({(first.service, row.key): row.dropped for row in first.topics})
        return +dropped
