"""Names and ordering of several instances of one service.

The instance that was started first is active (it leads); the others stand by and publish nothing until it has ended.
Names begin with the time of the start, so that sorting the names sorts the instances by age. Even if the clocks of the
hosts differ, all instances agree on the order.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Instance:
    """The parts of an instance name."""

    started_ms: int  # wall time of the instance's host
    host: str
    pid: int
    zid: str  # beginning of the id of its zenoh session

    @classmethod
    def parse(cls, name: str) -> Instance | None:
        """Parses an instance name; returns None if ``name`` is not one."""
        match = re.fullmatch(r"([0-9a-f]{12})~(.+)~(\d+)~([0-9a-f]{1,8})", name)
        return cls(int(match[1], 16), match[2], int(match[3]), match[4]) if match else None

    @property
    def name(self) -> str:
        """The name, valid as one chunk of a zenoh key."""
        host = re.sub(r"[^A-Za-z0-9_.-]", "-", self.host)[:64] or "host"
        return f"{self.started_ms:012x}~{host}~{self.pid}~{self.zid[:8]}"


def describe_instance(name: str) -> str:
    """Process and host of an instance, for log lines and error messages; other names are returned unchanged."""
    instance = Instance.parse(name)
    return name if instance is None else f"process {instance.pid} on {instance.host}"


class Instances:
    """The other instances of one service that are alive; updated by zenoh's threads and read by the service's loop."""

    def __init__(self, own_name: str) -> None:
        """``own_name`` is the name of this instance, which is not counted as another one."""
        self.own_name = own_name
        self.refresh: Callable[[], None] = lambda: None  # queries the active instances again, without waiting
        self._leading: set[str] = set()
        self._waiting: set[str] = set()
        self._lock = threading.Lock()

    def update(self, name: str, *, leads: bool, alive: bool) -> None:
        """Records that an instance that leads, or waits, is now alive or no longer alive."""
        # Ignore this session, also with an earlier start time: zenoh may repeat an old token of it.
        if name.partition("~")[2] == self.own_name.partition("~")[2]:
            return
        with self._lock:
            group = self._leading if leads else self._waiting
            (group.add if alive else group.discard)(name)

    def leaders(self) -> list[str]:
        """Other instances that lead, oldest first."""
        with self._lock:
            return sorted(self._leading)

    def may_lead(self) -> bool:
        """Whether no other instance leads and none that waits is older."""
        with self._lock:
            return not self._leading and self.own_name <= min(self._waiting, default=self.own_name)

    def must_yield(self) -> bool:
        """Whether an older instance leads too, as after two parts of a network were joined."""
        leaders = self.leaders()
        return bool(leaders) and leaders[0] < self.own_name


class SourceSelector:
    """Selects one source for each key on which several sessions publish although only one should.

    If instances of the publishing service lead, the oldest of them is selected. If there is none, as in a replay or
    with a robot's own driver, the first source is selected until it has been silent for ``timeout`` s.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._selected: dict[str, tuple[str, float]] = {}  # by key: the source and the time of its last message
        self._leaders: dict[tuple[str, str], frozenset[str]] = {}  # by robot and service

    def update(self, robot: str, service: str, name: str, alive: bool) -> None:  # noqa: FBT001 - called by zenoh
        """Records that an instance that leads is now alive or no longer alive."""
        if Instance.parse(name) is not None:
            before = self._leaders.get((robot, service), frozenset())
            self._leaders[robot, service] = before | {name} if alive else before - {name}

    def accepts(self, key: str, service: str, source: str, now: float) -> bool:
        """Whether to use a message of ``source``, received at ``now`` s on a key that ``service`` publishes."""
        leaders = self._leaders.get((key.split("/")[1], service))
        if leaders and (oldest := Instance.parse(min(leaders))) is not None:
            return source.startswith(oldest.zid)
        selected, last_time = self._selected.get(key, (source, now))
        if selected != source and now - last_time < self.timeout:
            return False
        self._selected[key] = (source, now)
        return True
