"""The process that replays a recording in a loop in place of a scanner."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from common.bus.bus import Bus, Link, open_bus
from common.errors import UserError
from common.log import logger, set_up_logging
from common.messages.requests import PlayerReply
from common.messages.topics import SCAN, TOPICS
from common.processes import interrupts_to_handle
from common.runtime.config import ServiceSettings, load_settings
from common.runtime.heartbeat import Heartbeat
from services.recorder.reader import read_recording
from services.recorder.replaying.replay import NAME, ReplayControl, ReplayOptions, replay

HEARTBEAT_PERIOD_S = 1.0


class ReplaySettings(ServiceSettings):
    """Replays a recording in place of the simulator: its scan, odom and truth, in a loop.

    Publishes under the robot name given by --robot. Refuses to start while a simulator of that robot is alive.
    `presage replay` has more options. This replay can be controlled with the query `player`.

    Examples:
      python -m services.recorder.replaying.service --replay drive.mcap                   reads recordings/drive.mcap
      python -m services.recorder.replaying.service --directory logs --replay drive.mcap --robot truck
      PRESAGE_SCANNER=replay PRESAGE_REPLAY=drive.mcap docker compose up

    """

    service: ClassVar[str] = NAME
    program: ClassVar[str] = "python -m services.recorder.replaying.service"

    replay: Annotated[str, Field(description="file name of the recording, in --directory")] = ""
    directory: Annotated[Path, Field(description="folder of recordings")] = Path("recordings")
    rate: Annotated[float, Field(gt=0, le=1000, description="factor on the original speed")] = 1.0

    def file(self) -> Path:
        """Path of the recording. Raises UserError if it does not exist."""
        path = self.directory / self.replay
        if not self.replay or not path.is_file():
            existing = sorted(found.name for found in self.directory.glob("*.mcap"))
            raise UserError(
                f"no recording {self.replay!r} in {self.directory}: name one with --replay or PRESAGE_REPLAY; "
                f"there {'are' if existing else 'is'} {', '.join(existing[-5:]) or 'none'}"
            )
        return path


def options_for(path: Path, settings: ReplaySettings) -> ReplayOptions:
    """Options that replay the simulator's topics in a loop. Raises UserError if the recording has no scans."""
    of_simulator = {topic.name for topic in TOPICS if topic.publisher == SCAN.publisher}
    recorded = {topic.name for topic in read_recording(path).topics().values()} & of_simulator
    if SCAN.name not in recorded:
        raise UserError(f"{path}: no scans in this recording: choose one that has them (`presage info FILE`)")
    return ReplayOptions(frozenset(recorded), rate=settings.rate, loop=True, robot=settings.robot)


class ReplayHeartbeat:
    """Writes heartbeats during the replay. An instance is the replay's progress callback."""

    def __init__(self, settings: ReplaySettings) -> None:
        self._heart = Heartbeat(settings.heartbeat, NAME, settings.robot)
        self._next_at = 0.0  # monotonic time of the next heartbeat, s
        self._bus: Bus | None = None
        self._control: ReplayControl | None = None

    @contextmanager
    def open_session(self, link: Link) -> Iterator[Bus]:
        """Opens the replay's bus session and keeps it to report the link."""
        with open_bus(link) as self._bus:
            yield self._bus

    @contextmanager
    def attach(self, control: ReplayControl) -> Iterator[None]:
        """Keeps the control of the replay to report its counts."""
        self._control = control
        yield

    def __call__(self, state: PlayerReply) -> None:
        """Writes a heartbeat if one is due."""
        if self._bus is None or self._control is None or (now := time.monotonic()) < self._next_at:
            return
        counts = {key: {"published": count} for key, count in self._control.counts.items()}
        self._heart.beat(counts, linked=self._bus.linked(), note="paused" if state.paused else "", idle=state.paused)
        self._next_at = now + HEARTBEAT_PERIOD_S


def main(argv: list[str] | None = None) -> None:
    """Replays until SIGTERM, Ctrl-C or the end of its terminal. Exits with status 0, or with 2 after a UserError."""
    stop = threading.Event()
    for number in interrupts_to_handle():
        signal.signal(number, lambda *_: stop.set())
    try:
        settings = load_settings(ReplaySettings, argv)
        set_up_logging(settings.log_level, as_json=settings.log_json)
        path = settings.file()
        options, heartbeat, log = options_for(path, settings), ReplayHeartbeat(settings), logger(NAME)
        log.info("replaying", file=str(path), topics=",".join(sorted(options.only or ())), robot=settings.robot)
        replay(
            path,
            settings.link(),
            options,
            on_progress=heartbeat,
            stop=stop,
            open_session=heartbeat.open_session,
            control_context=heartbeat.attach,
        )
        log.info("ended")
    except UserError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
