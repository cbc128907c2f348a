"""Names and ordering of several instances of one service.

The instance that was started first leads; others stand by and say nothing, until it is gone. Names begin with the time
of the start, so that names in order are instances by age (where clocks differ, at least all agree on the order).
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Instance:
    """What a name says."""

    started_ms: int  # wall time of the instance's host
    host: str
    pid: int
    zid: str  # beginning of its zenoh session's id

    @classmethod
    def parse(cls, name: str) -> Instance | None:
        """None: no name of ours."""
        match = re.fullmatch(r"([0-9a-f]{12})~(.+)~(\d+)~([0-9a-f]*)", name)
        return cls(int(match[1], 16), match[2], int(match[3]), match[4]) if match else None

    @property
    def name(self) -> str:
        """One chunk of a key."""
        host = re.sub(r"[^A-Za-z0-9_.-]", "-", self.host)[:64] or "host"
        return f"{self.started_ms:012x}~{host}~{self.pid}~{self.zid[:8]}"


def describe_instance(name: str) -> str:
    """For people."""
    instance = Instance.parse(name)
    return name if instance is None else f"process {instance.pid} on {instance.host}"


class Instances:
    """Which instances of one service are there; zenoh's threads tell, a loop asks."""

    def __init__(self, me: str) -> None:
        """Nobody but ``me``, who does not count."""
        self.me = me
        self.look: Callable[[], None] = lambda: None  # asks who leads, without waiting
        self._leading: set[str] = set()
        self._waiting: set[str] = set()
        self._lock = threading.Lock()

    def change(self, name: str, *, leads: bool, there: bool) -> None:
        """An instance leads or waits from now on, or does so no more."""
        # This session itself: as it is now, or as it led this robot before, which zenoh may tell again.
        if name.partition("~")[2] == self.me.partition("~")[2]:
            return
        with self._lock:
            group = self._leading if leads else self._waiting
            (group.add if there else group.discard)(name)

    def leaders(self) -> list[str]:
        """Others that lead, by age."""
        with self._lock:
            return sorted(self._leading)

    def may_lead(self) -> bool:
        """Nobody leads, and none who waits is older."""
        with self._lock:
            return not self._leading and self.me <= min(self._waiting, default=self.me)

    def must_yield(self) -> bool:
        """Another leads that was started before: two halves of a network have met."""
        leaders = self.leaders()
        return bool(leaders) and leaders[0] < self.me


class SourceSelector:
    """Of several that publish what one should, only one is heard.

    That is the service's own instance, where one says that it leads, of two the elder; where none does (a replay, a
    robot's own driver), the first, until it has been silent for a while.
    """

    def __init__(self, patience: float) -> None:
        """``patience``: s of silence."""
        self.patience = patience
        self._heard: dict[str, tuple[str, float]] = {}  # by key: who, and when last
        self._owners: dict[tuple[str, str], frozenset[str]] = {}  # by robot and service

    def change(self, robot: str, service: str, name: str, there: bool) -> None:  # noqa: FBT001 - zenoh's thread
        """An instance leads from now on, or no more."""
        if Instance.parse(name) is not None:
            before = self._owners.get((robot, service), frozenset())
            self._owners[robot, service] = before | {name} if there else before - {name}

    def takes(self, key: str, service: str, source: str, now: float) -> bool:
        """Whether a message of ``source`` that came at ``now`` s counts on a key that ``service`` publishes."""
        owners = self._owners.get((key.split("/")[1], service))
        if owners and (eldest := Instance.parse(min(owners))) is not None:
            return source.startswith(eldest.zid)
        who, when = self._heard.get(key, (source, now))
        if who != source and now - when < self.patience:
            return False
        self._heard[key] = (source, now)
        return True
