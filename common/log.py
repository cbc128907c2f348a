"""Logging to stderr, as text or as JSON lines."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TextIO

import structlog

from common.log_capture import Line, capture

if TYPE_CHECKING:
    from types import TracebackType

Logger = structlog.stdlib.BoundLogger
_captured: list[TextIO] = []  # the old stderr, once descriptors were taken over


def begin_logging(service: str, argv: Sequence[str] | None = None) -> None:
    """Where lines are to be JSON, so from the first one on: what is wrong with the settings is a line too."""
    words = sys.argv[1:] if argv is None else argv
    variable = os.environ.get("PRESAGE_LOG_JSON", "").lower() in {"1", "true", "yes", "on", "t", "y"}
    if "--no-log-json" not in words and ("--log-json" in words or variable):
        set_up_logging(as_json=True, service=service)


def report_failure(service: str, error: Exception) -> None:
    """Why a process ends, in one line."""
    if _captured:
        logger(service).error(str(error))
    else:
        print(f"{service}: {error}", file=sys.stderr)


def set_up_logging(level: str = "info", *, as_json: bool = False, service: str = "", robot: str = "") -> None:
    """One handler for structlog and for the standard library's loggers (zenoh.handlers reports callbacks there).

    As JSON every line is one object with time, level, service, robot, event: warnings, uncaught exceptions and what
    native code writes included.
    """
    shared: list[structlog.types.Processor] = [
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", key="time")
        if as_json
        else structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
    ]
    renderers: list[structlog.types.Processor] = [
        structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), pad_event_to=0)
    ]
    if as_json:
        renderers = [
            _of_whom(service, robot),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(serializer=_as_json),
        ]
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
    )
    handler = logging.StreamHandler(_json_stream() if as_json else sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[*shared, structlog.stdlib.add_logger_name] if as_json else shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderers],
        )
    )
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


def _of_whom(service: str, robot: str) -> structlog.types.Processor:
    """Whose line it is; a line that names a robot itself speaks of that one."""

    def add(_logger: Any, _method: str, event: structlog.types.EventDict) -> structlog.types.EventDict:
        head = {name: event.pop(name) for name in ("time", "level") if name in event}
        whose = {"service": event.pop("service", service), "robot": event.pop("robot", robot)}
        return {**head, **whose, "event": event.pop("event", ""), **event}

    return add


def _as_json(event: Any, **options: Any) -> str:
    """One line of JSON; a number that JSON does not know becomes a word."""
    try:
        return json.dumps(event, allow_nan=False, **options)
    except ValueError:
        plain = json.loads(json.dumps(event, **options), parse_constant=str)
        return json.dumps(plain, allow_nan=False)


def _json_stream() -> TextIO:
    """The old stderr; descriptors, warnings and exceptions are led into the log the first time."""
    if not _captured:
        _captured.append(capture(_tell))
        logging.raiseExceptions = False  # a stderr that nobody reads must not feed itself with complaints
        logging.captureWarnings(capture=True)
        sys.excepthook = _uncaught
        threading.excepthook = lambda args: _uncaught(args.exc_type, args.exc_value, args.exc_traceback)
    return _captured[0]


def _tell(line: Line) -> None:
    logging.getLogger(line.logger).log(logging.getLevelName(line.level.upper()), "%s", line.text)


def _uncaught(kind: type[BaseException], error: BaseException | None, trace: TracebackType | None) -> None:
    logging.getLogger("uncaught").critical("%s: %s", kind.__name__, error, exc_info=(kind, error, trace))  # type: ignore[arg-type]


def logger(service: str) -> Logger:
    """The logger of a service."""
    bound: Logger = structlog.get_logger(service).bind()
    return bound


class LogRateLimiter:
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
