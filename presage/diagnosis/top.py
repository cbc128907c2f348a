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
from presage.diagnosis.health_board import WATCHED, Board, Rate, Row
from presage.live.bus_watch import session

PERIOD = 0.5  # s between two looks
PATIENCE = 5.0  # s for the router to say who is there; it answers at once unless the machine is busy
LISTEN = (1.5, 4.0)  # s, at least and at most, for a single table
COLOURS = {"alive": "green", "begins": "cyan", "silent": "red", "gone": "red", "missing": "bold red", "off": "dim"}
LEFT = ("service", "state", "sends, Hz", "hears, Hz", "note")
COLUMNS = (*LEFT[:2], "pulse", "up", *LEFT[2:4], "dropped", "broken", "failed", "latency", LEFT[4])


def run_top(link: Link, robots: list[str], console: Console, *, once: bool) -> int:
    """Until Ctrl-C, status 0; ``once`` (and where there is no terminal) one table, status 1 where somebody is missing.

    Raises UserError where no session answers.
    """
    boards = {robot: Board(robot, link.connect) for robot in robots}
    with session(link) as bus:
        feed = Feed(bus, boards)
        if once or not console.is_terminal:
            return _once(feed, console)
        # Ctrl-C is how it ends.
        with suppress(KeyboardInterrupt), Live(console=console, auto_refresh=False, screen=True) as live:
            while True:
                feed.run(PERIOD)
                live.update(tables(boards, time.monotonic()), refresh=True)
    return 0


def _once(feed: Feed, console: Console) -> int:
    least, most = (time.monotonic() + seconds for seconds in LISTEN)
    while (now := time.monotonic()) < least or (now < most and not feed.complete()):
        feed.run(0.1)
    now = time.monotonic()
    console.print(tables(feed.boards, now))
    return 0 if all(row.well for board in feed.boards.values() for row in board.rows(now)) else 1


class Feed:
    """Moves what is on the bus to the boards."""

    def __init__(self, bus: Bus, boards: dict[str, Board]) -> None:
        """From now on."""
        self.bus, self.boards, self._inbox = bus, boards, Inbox()
        for robot in boards:
            for topic in WATCHED:
                bus.subscribe(topic, self._inbox, keep_all=True, robot=robot)

    def run(self, seconds: float) -> None:
        """Listen for so long."""
        deadline = time.monotonic() + seconds
        for robot, board in self.boards.items():
            board.see_alive(self.bus.alive(timeout=PATIENCE, robot=robot), time.monotonic())
        while True:
            sample = self._inbox.get(max(0.0, deadline - time.monotonic()))
            if isinstance(sample, Sample):
                self._take(sample)
            elif time.monotonic() >= deadline:
                return

    def complete(self) -> bool:
        """Whether everybody who is there has been heard."""
        return all(board.heard_of_all() for board in self.boards.values())

    def _take(self, sample: Sample) -> None:
        topic, now = topic_of(sample.key), time.monotonic()
        board = self.boards.get(sample.key.split("/")[1])
        if topic is not None and board is not None:
            with suppress(DecodeError):
                message = topic.message.decode(sample.payload)
                if isinstance(message, Health) and sample.key != topic.key(board.robot, message.service):
                    return  # it speaks for another
                board.hear(topic, message, sample.published_ns or sample.received_ns, now)


def tables(boards: dict[str, Board], now: float) -> Group:
    """One table a robot."""
    return Group(*(_table(board, now) for board in boards.values()))


def _table(board: Board, now: float) -> Table:
    table = Table(title=f"robot {board.robot}", title_justify="left")
    for column in COLUMNS:
        table.add_column(column, justify="left" if column in LEFT else "right", no_wrap=column not in LEFT)
    for row in board.rows(now):
        table.add_row(*_cells(row), style="dim" if row.state == "off" else "")
    return table


def _cells(row: Row) -> list[Text]:
    counts = [(row.dropped, "yellow"), (row.undecodable, "yellow"), (row.failed, "red")]
    there = row.uptime is not None
    return [
        _plain(row.name),
        Text({"off": "not running"}.get(row.state, row.state), COLOURS[row.state]),
        Text(f"{row.age:.1f} s" if row.age is not None else ""),
        Text(_duration(row.uptime) if row.uptime is not None else ""),
        _rates(row.sends),
        _rates(row.hears),
        *(Text(f"{count}" if there else "", colour if count else "") for count, colour in counts),
        Text(f"{row.latency_ms:.1f} ms" if row.latency_ms is not None else ""),
        _plain(row.note),
    ]


def _plain(text: str) -> Text:
    """Words from the bus, which must not steer the terminal."""
    return Text("".join(c if c.isprintable() else "?" for c in text))


def _rates(rates: tuple[Rate, ...]) -> Text:
    words = [Text(f"{rate.topic} {rate.hz:.1f}", "yellow" if rate.slow else "") for rate in rates]
    return Text("  ").join(words)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
