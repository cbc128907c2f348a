"""Reports whether scans of a robot outside Docker Compose arrive."""

from __future__ import annotations

import time
from typing import ClassVar

from common.bus.inbox import Sample
from common.messages.topics import SCAN, Topic
from common.runtime.config import ServiceSettings
from common.runtime.service import Service, main

SCAN_TIMEOUT_S = 5.0


class RemoteSettings(ServiceSettings):
    """Logs when scans of a robot outside Docker Compose arrive and when they stop. It publishes no scans itself.

    Examples:
      python -m common.containers.remote_robot
      PRESAGE_SCANNER=none docker compose up         the robot then connects to the router's port

    """

    service: ClassVar[str] = "remote"
    program: ClassVar[str] = "python -m common.containers.remote_robot"


class RemoteService(Service):
    """Watches the scans of one robot."""

    name: ClassVar[str] = "remote"
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN,)

    def __init__(self, settings: RemoteSettings) -> None:
        """Starts in the state that no scan has arrived."""
        super().__init__(settings)
        self.note = "no scan so far"
        self._last_scan: float | None = None  # s, monotonic clock; None while no scans arrive

    def on_sample(self, sample: Sample) -> None:  # noqa: ARG002 - the contents do not matter
        """Records the time, and logs the first scan."""
        if self._last_scan is None:
            self.log.info("scans are arriving", robot=self.loop.bus.robot)
        self._last_scan, self.note = time.monotonic(), ""

    def due(self) -> float | None:
        """Seconds until scans count as stopped, or None if none arrive."""
        return None if self._last_scan is None else self._last_scan + SCAN_TIMEOUT_S - time.monotonic()

    def on_timer(self) -> None:
        """Logs that scans have stopped."""
        self._last_scan, self.note = None, f"no scan for {SCAN_TIMEOUT_S:g} s"
        self.log.warning(self.note, robot=self.loop.bus.robot)


if __name__ == "__main__":
    main(RemoteSettings, RemoteService)
