"""The process that plays a recording in a loop in place of the scanner."""

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
from common.runtime.config import ServiceSettings, load_settings
from common.runtime.heartbeat import Heartbeat
from services.recorder.reader import read_recording
from services.recorder.replaying.replay import NAME, ReplayControl, ReplayOptions, replay

HEARTBEAT_PERIOD_S = 1.0  # s between heartbeats


class PlayingSettings(ServiceSettings):
    """A recording in the scanner's place: what the simulator published (scan, odom, truth), in a loop.

    A robot's recording goes out under the name that --robot says. Refused while a simulator of that name is alive.
    `presage replay` has more to choose from, and steers this one too, over query `player`.

    Examples:
      python -m services.recorder.replaying.service --replay drive.mcap                   of the folder recordings
      python -m services.recorder.replaying.service --directory logs --replay drive.mcap --robot truck
      PRESAGE_SCANNER=replay PRESAGE_REPLAY=drive.mcap docker compose up

    """

    service: ClassVar[str] = NAME
    program: ClassVar[str] = "python -m services.recorder.replaying.service"

    replay: Annotated[str, Field(description="the recording, a file of the folder")] = ""
    directory: Annotated[Path, Field(description="folder of recordings")] = Path("recordings")
    rate: Annotated[float, Field(gt=0, le=1000, description="times its own timing")] = 1.0

    def file(self) -> Path:
        """The recording; raises UserError where there is none of that name."""
        path = self.directory / self.replay
        if not self.replay or not path.is_file():
            there = sorted(found.name for found in self.directory.glob("*.mcap"))
            raise UserError(
                f"no recording {self.replay!r} in {self.directory}: name one with --replay or PRESAGE_REPLAY; "
                f"there {'are' if there else 'is'} {', '.join(there[-5:]) or 'none'}"
            )
        return path


def options_for(path: Path, settings: PlayingSettings) -> ReplayOptions:
    """What the simulator sent; raises UserError where there is no scan."""
    mine = {topic.name for topic in TOPICS if topic.publisher == SCAN.publisher}
    there = {topic.name for topic in read_recording(path).topics().values()} & mine
    if SCAN.name not in there:
        raise UserError(f"{path}: no scans in this recording: choose one that has them (`presage info FILE`)")
    return ReplayOptions(frozenset(there), rate=settings.rate, loop=True, robot=settings.robot)


class ReplayHeartbeat:
    """Heartbeats while the replay goes on."""

    def __init__(self, settings: PlayingSettings) -> None:
        """Nothing has been sent."""
        self._heart = Heartbeat(settings.heartbeat, NAME, settings.robot)
        self._at = 0.0  # s, monotonic, of the next
        self._bus: Bus | None = None
        self._remote: ReplayControl | None = None

    @contextmanager
    def opening(self, link: Link) -> Iterator[Bus]:
        """The replay's session."""
        with open_bus(link) as self._bus:
            yield self._bus

    @contextmanager
    def steering(self, remote: ReplayControl) -> Iterator[None]:
        """The replay begins."""
        self._remote = remote
        yield

    def __call__(self, state: PlayerReply) -> None:
        """It stands there now."""
        if self._bus is None or self._remote is None or (now := time.monotonic()) < self._at:
            return
        counts = {key: {"published": count} for key, count in self._remote.counts.items()}
        self._heart.beat(counts, linked=self._bus.linked(), note="paused" if state.paused else "")
        self._at = now + HEARTBEAT_PERIOD_S


def main(argv: list[str] | None = None) -> None:
    """Replay until SIGTERM or Ctrl-C; status 0 then, 2 and one line where the user can mend something."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        settings = load_settings(PlayingSettings, argv)
        set_up_logging(settings.log_level, as_json=settings.log_json)
        path = settings.file()
        choice, pulse, log = options_for(path, settings), ReplayHeartbeat(settings), logger(NAME)
        log.info("replaying", file=str(path), topics=",".join(sorted(choice.only or ())), robot=settings.robot)
        replay(
            path, settings.link(), choice, on_progress=pulse, stop=stop, opening=pulse.opening, steering=pulse.steering
        )
        log.info("ended")
    except UserError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
