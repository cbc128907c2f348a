"""`presage top`: health of every service."""

from __future__ import annotations

import time
from contextlib import suppress

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from common.bus.bus import Bus, Link
from common.bus.inbox import Inbox, Sample
from common.messages.definitions import Health
from common.messages.topics import topic_of
from common.messages.wire import DecodeError
from presage.diagnosis.health_board import WATCHED, HealthBoard, ServiceRow, TopicRate
from presage.live.latest_messages import session_bus
from presage.terminal.output import printable

REFRESH_PERIOD_S = 0.5
LIVELINESS_TIMEOUT_S = 5.0  # for the router's list of tokens; it answers at once unless the machine is busy
MIN_OBSERVATION_S, MAX_OBSERVATION_S = 1.5, 4.0  # for a single table
COLOURS = {
    "alive": "green",
    "starting": "cyan",
    "silent": "red",
    "gone": "red",
    "missing": "bold red",
    "not running": "dim",
}
COLUMNS = (
    "service",
    "state",
    "age",
    "up",
    "sends, Hz",
    "gets, Hz",
    "dropped",
    "invalid",
    "failed",
    "latency",
    "note",
)
LEFT_ALIGNED = {"service", "state", "sends, Hz", "gets, Hz", "note"}


def run_top(link: Link, robots: list[str], console: Console, *, once: bool) -> int:
    """Shows the health of the robots' services until Ctrl-C and returns 0.

    With ``once``, or without a terminal, prints one table and returns 1 if a service needs attention. Raises UserError
    if there is no session.
    """
    boards = {robot: HealthBoard(robot, link.connect_option) for robot in robots}
    with session_bus(link) as bus:
        feed = BoardFeed(bus, boards)
        if once or not console.is_terminal:
            return _once(feed, console)
        with suppress(KeyboardInterrupt), Live(console=console, auto_refresh=False, screen=True) as live:
            while True:
                feed.run(REFRESH_PERIOD_S)
                live.update(tables(boards, time.monotonic()), refresh=True)
    return 0


def _once(feed: BoardFeed, console: Console) -> int:
    start = time.monotonic()
    while (passed := time.monotonic() - start) < MIN_OBSERVATION_S or (
        passed < MAX_OBSERVATION_S and not feed.complete()
    ):
        feed.run(0.1)
    now = time.monotonic()
    console.print(tables(feed.boards, now))
    return 1 if any(row.service.problem for board in feed.boards.values() for row in board.rows(now)) else 0


class BoardFeed:
    """Passes messages and liveliness tokens from the bus to the boards."""

    def __init__(self, bus: Bus, boards: dict[str, HealthBoard]) -> None:
        """Subscribes to the topics of all ``boards``."""
        self.bus, self.boards, self._inbox = bus, boards, Inbox()
        for robot in boards:
            for topic in WATCHED:
                bus.subscribe(topic, self._inbox, keep_all=True, robot=robot)

    def run(self, seconds: float) -> None:
        """Updates the boards for ``seconds`` s."""
        deadline = time.monotonic() + seconds
        for robot, board in self.boards.items():
            board.monitor.set_alive(self.bus.alive(timeout=LIVELINESS_TIMEOUT_S, robot=robot), time.monotonic())
        while True:
            sample = self._inbox.get(max(0.0, deadline - time.monotonic()))
            if isinstance(sample, Sample):
                self._take(sample)
            elif time.monotonic() >= deadline:
                return

    def complete(self) -> bool:
        """Whether a health message of every live service has come."""
        now = time.monotonic()
        services = [each for board in self.boards.values() for each in board.monitor.services(now)]
        return all(each.has_started for each in services if each.state != "absent")

    def _take(self, sample: Sample) -> None:
        topic, now = topic_of(sample.key), time.monotonic()
        board = self.boards.get(sample.key.split("/")[1])
        if topic is not None and board is not None:
            with suppress(DecodeError):
                message = topic.message.decode(sample.payload)
                if isinstance(message, Health) and sample.key != topic.key(board.robot, message.service):
                    return  # published on the key of another service
                board.add_message(topic, message, sample.published_ns or time.time_ns(), now)


def tables(boards: dict[str, HealthBoard], now: float) -> Group:
    """One table for each robot."""
    return Group(*(_table(board, now) for board in boards.values()))


def _table(board: HealthBoard, now: float) -> Table:
    table = Table(title=f"robot {board.robot}", title_justify="left")
    for column in COLUMNS:
        left = column in LEFT_ALIGNED
        # Commands in notes may have long words, which would otherwise be cut off.
        table.add_column(column, justify="left" if left else "right", no_wrap=not left, overflow="fold")
    for row in board.rows(now):
        table.add_row(*_cells(row), style="dim" if row.state == "not running" else "")
    return table


def _cells(row: ServiceRow) -> list[Text]:
    health, age = row.service.health, row.service.age
    return [
        Text(printable(row.service.name)),
        Text(row.state, COLOURS[row.state]),
        Text(f"{age:.1f} s" if age is not None else ""),
        Text(_duration(health.uptime) if health is not None else ""),
        _rates(row.published),
        _rates(row.received),
        *_counts(health),
        Text(f"{row.latency_ms:.1f} ms" if row.latency_ms is not None else ""),
        Text(printable(row.note)),
    ]


def _counts(health: Health | None) -> list[Text]:
    """Numbers of dropped and undecodable messages and of failed steps, as cells."""
    if health is None:
        return [Text("")] * 3
    dropped, undecodable = (sum(getattr(row, kind) for row in health.topics) for kind in ("dropped", "undecodable"))
    counts = [(dropped, "yellow"), (undecodable, "yellow"), (health.counters.get("failed", 0), "red")]
    return [Text(f"{count}", colour if count else "") for count, colour in counts]


def _rates(rates: tuple[TopicRate, ...]) -> Text:
    words = [Text(f"{rate.topic} {rate.hz:.1f}", "yellow" if rate.slow else "") for rate in rates]
    return Text("  ").join(words)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
