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

from common.log_capture import CapturedLine, capture

if TYPE_CHECKING:
    from types import TracebackType

Logger = structlog.stdlib.BoundLogger
_original_stderr: list[TextIO] = []  # the stream in use since stderr was redirected; empty before


def begin_logging(service: str, argv: Sequence[str] | None = None) -> None:
    """Sets up JSON logging before the settings are read, if requested there, so that errors in them are JSON too."""
    arguments = sys.argv[1:] if argv is None else argv
    enabled = os.environ.get("PRESAGE_LOG_JSON", "").lower() in {"1", "true", "yes", "on", "t", "y"}
    if "--no-log-json" not in arguments and ("--log-json" in arguments or enabled):
        set_up_logging(as_json=True, service=service)


def report_failure(service: str, error: Exception) -> None:
    """Logs or prints, in one line, the error that ends the process."""
    if _original_stderr:
        logger(service).error(str(error))
    else:
        print(f"{service}: {error}", file=sys.stderr)


def set_up_logging(level: str = "info", *, as_json: bool = False, service: str = "", robot: str = "") -> None:
    """Installs one handler for structlog and the standard library's loggers (used by zenoh.handlers for callbacks).

    With ``as_json``, every line is an object with time, level, service, robot and event, including warnings, uncaught
    exceptions and the output of native code.
    """
    shared: list[structlog.types.Processor] = [
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", key="time")
        if as_json
        else structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
    ]
    renderers: list[structlog.types.Processor] = [
        structlog.dev.ConsoleRenderer(
            colors=sys.stderr.isatty(),
            pad_event_to=0,
            exception_formatter=structlog.dev.plain_traceback,  # Rich's prints all local variables, hundreds of lines
        )
    ]
    if as_json:
        renderers = [
            _add_origin(service, robot),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(serializer=_as_json),
        ]
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
    )
    handler = logging.StreamHandler(_redirect_stderr() if as_json else sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[*shared, structlog.stdlib.add_logger_name] if as_json else shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderers],
        )
    )
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


def _add_origin(service: str, robot: str) -> structlog.types.Processor:
    """Processor that adds service and robot to a line, unless it has its own, and puts the keys in order."""

    def add(_logger: Any, _method: str, event: structlog.types.EventDict) -> structlog.types.EventDict:
        head = {name: event.pop(name) for name in ("time", "level") if name in event}
        origin = {"service": event.pop("service", service), "robot": event.pop("robot", robot)}
        return {**head, **origin, "event": event.pop("event", ""), **event}

    return add


def _as_json(event: Any, **options: Any) -> str:
    """One line of JSON; NaN and infinities, which JSON lacks, become strings."""
    try:
        return json.dumps(event, allow_nan=False, **options)
    except ValueError:
        plain = json.loads(json.dumps(event, **options), parse_constant=str)
        return json.dumps(plain, allow_nan=False)


def _redirect_stderr() -> TextIO:
    """Returns the original stderr; the first call redirects file descriptors, warnings and exceptions into the log."""
    if not _original_stderr:
        _original_stderr.append(capture(_log_line))
        logging.raiseExceptions = False  # otherwise errors in writing to stderr would themselves be logged to stderr
        logging.captureWarnings(capture=True)
        sys.excepthook = _uncaught
        threading.excepthook = lambda args: _uncaught(args.exc_type, args.exc_value, args.exc_traceback)
    return _original_stderr[0]


def _log_line(line: CapturedLine) -> None:
    logging.getLogger(line.logger).log(logging.getLevelName(line.level.upper()), "%s", line.text)


def _uncaught(kind: type[BaseException], error: BaseException | None, trace: TracebackType | None) -> None:
    logging.getLogger("uncaught").critical("%s: %s", kind.__name__, error, exc_info=(kind, error, trace))  # type: ignore[arg-type]


def logger(service: str) -> Logger:
    """The logger of a service."""
    bound: Logger = structlog.get_logger(service).bind()
    return bound


class LogRateLimiter:
    """Allows one log line a second for each subject."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}

    def __call__(self, subject: str) -> bool:
        """Whether to log a line about ``subject`` now."""
        now = time.monotonic()
        if now - self._last.get(subject, -1.0) < 1.0:
            return False
        if len(self._last) > 1000:  # invented keys must not fill memory
            self._last.clear()
        self._last[subject] = now
        return True
