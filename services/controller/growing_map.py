"""The map that the mapper builds, prepared for planning in a thread: it takes longer than the period of the scans."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from services.controller.policies.free_space import FreeSpace
from services.controller.policies.geodesic_field import FreeSpaceGraph

if TYPE_CHECKING:
    from common.messages.definitions import Map

JUMP_M = 0.05  # a key scan that moved farther moved with a loop closure, and obstacles seen before are elsewhere


@dataclass(frozen=True)
class PlannedMap:
    """A version of the mapper's map, ready for planning."""

    message: Map
    graph: FreeSpaceGraph
    jumped: bool  # it does not fit the version before


def plan_map(message: Map, before: Map | None, radius: float) -> PlannedMap:
    """Prepare a map for a robot of ``radius`` m; ``before`` is the version that was prepared last."""
    graph = FreeSpaceGraph(FreeSpace.of_map(message.grid), radius)
    return PlannedMap(message, graph, before is not None and _jumped(before, message))


def _jumped(before: Map, after: Map) -> bool:
    count = len(before.poses)
    if len(after.poses) < count:
        return True  # mapping started again
    return bool(np.hypot(*(after.poses[:count] - before.poses)[:, :2].T).max(initial=0.0) > JUMP_M)


class MapUpdates:
    """Prepares the newest map, one at a time; those that come meanwhile replace one another."""

    def __init__(self, radius: float, wake: Callable[[], None]) -> None:
        """``wake`` is called from the thread when a map is ready."""
        self.radius, self._wake = radius, wake
        self.latest: Map | None = None  # that was prepared last
        self._waiting: Map | None = None
        self._job: Future[PlannedMap] | None = None
        self._pool = ThreadPoolExecutor(1, "map")

    def add(self, message: Map) -> None:
        """Prepare a map now or next."""
        self._waiting = message
        self._start()

    def _start(self) -> None:
        if self._job is None and self._waiting is not None:
            message, self._waiting = self._waiting, None
            self._job = self._pool.submit(plan_map, message, self.latest, self.radius)
            self._job.add_done_callback(lambda _: self._wake())

    @property
    def ready(self) -> bool:
        """Whether `take` returns a map."""
        return self._job is not None and self._job.done()

    def take(self) -> PlannedMap:
        """The map that is ready; starts on the next one."""
        assert self._job is not None  # noqa: S101 - as `ready` says
        job, self._job = self._job, None
        try:
            planned = job.result()
            self.latest = planned.message
            return planned
        finally:
            self._start()

    def close(self) -> None:
        """Wait for the present map."""
        self._pool.shutdown(cancel_futures=True)
