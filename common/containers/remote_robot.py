"""Reports whether scans of a robot outside compose arrive."""

from __future__ import annotations

import time
from typing import ClassVar

from common.bus.inbox import Sample
from common.messages.topics import SCAN, Topic
from common.runtime.config import ServiceSettings
from common.runtime.service import Service, main

SILENT = 5.0  # s without a scan, then it is said


class RemoteSettings(ServiceSettings):
    """Waits for the scans of a robot that is elsewhere, and logs when they come and when they stop. It sends none.

    Examples:
      python -m common.containers.remote_robot
      PRESAGE_SCANNER=none docker compose up         and the robot connects to the router's port

    """

    service: ClassVar[str] = "remote"
    program: ClassVar[str] = "python -m common.containers.remote_robot"


class RemoteService(Service):
    """Hears scans, answers nothing."""

    name: ClassVar[str] = "remote"
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN,)

    def __init__(self, settings: RemoteSettings) -> None:
        """Nothing has come yet."""
        super().__init__(settings)
        self.note = "no scan so far"
        self._at: float | None = None  # of the last scan, while they come

    def on_sample(self, sample: Sample) -> None:  # noqa: ARG002 - that one came is all
        """It is there."""
        if self._at is None:
            self.log.info("scans come", robot=self.loop.bus.robot)
        self._at, self.note = time.monotonic(), ""

    def due(self) -> float | None:
        """Until the silence is worth a word."""
        return None if self._at is None else self._at + SILENT - time.monotonic()

    def on_timer(self) -> None:
        """They stopped."""
        self._at, self.note = None, f"no scan for {SILENT:g} s"
        self.log.warning(self.note, robot=self.loop.bus.robot)


if __name__ == "__main__":
    main(RemoteSettings, RemoteService)
