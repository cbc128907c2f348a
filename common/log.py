"""Log lines, to stderr, readable or as JSON; zenoh's own complaints included."""

from __future__ import annotations

import logging
import sys
import time

import structlog

Logger = structlog.stdlib.BoundLogger


def set_up_logging(level: str = "info", *, as_json: bool = False) -> None:
    """One handler for structlog and for the standard library's loggers (zenoh.handlers reports callbacks there)."""
    shared: list[structlog.types.Processor] = [
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso" if as_json else "%H:%M:%S", utc=as_json),
    ]
    renderer: structlog.types.Processor = (
        structlog.processors.JSONRenderer()
        if as_json
        else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), pad_event_to=0)
    )
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, renderer],
        )
    )
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


def logger(service: str) -> Logger:
    """The logger of a service."""
    bound: Logger = structlog.get_logger(service).bind()
    return bound


class OncePerSecond:
    """Says yes at most once a second for each subject, and counts what it silenced."""

    def __init__(self) -> None:
        """Begin with a yes for everything."""
        self._last: dict[str, float] = {}
        self.silenced: dict[str, int] = {}

    def __call__(self, subject: str) -> bool:
        """Whether it may be said now."""
        now = time.monotonic()
        if now - self._last.get(subject, -1.0) < 1.0:
            self.silenced[subject] = self.silenced.get(subject, 0) + 1
            return False
        if len(self._last) > 1000:  # hostile keys must not fill memory
            self._last.clear()
        self._last[subject] = now
        return True
