"""Counts and logs connections that the router refused, read from zenoh's log.

The reasons are those that the log of zenoh 1.10 distinguishes. A refused message is reported with the certificate's
name, its key and its kind; a wrong password with the name of the last certificate that was presented; a connection
without a valid certificate has no name. Messages without subscribers are not sent to the router and cannot be reported.
"""

from __future__ import annotations

import os
import re
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from common.log import Logger, LogRateLimiter
from common.messages.topics import QUERIES, TOPICS

# Zenoh logs errors, as in every session, and the lines from which refusals are read.
LOG_FILTER = (
    "error,zenoh::api::session=off,zenoh::net::protocol::gossip=off,zenoh::net::routing::hat=off,"
    "zenoh::net::routing::interceptor::access_control=trace,"
    "zenoh_transport::unicast::establishment::accept=debug,zenoh_link_tls::unicast=debug"
)
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
LINE = re.compile(r"^\S+Z +(?P<level>[A-Z]+) .*?(?P<thread>ThreadId\(\d+\)) (?P<target>\S+): (?P<text>.*)$")
DENIED = re.compile(
    r"(?P<zid>[0-9a-f]+)(?: on \S+)? is unauthorized to (?P<action>.+?) \((?P<flow>\w+)\) on (?P<key>\S+)"
)
CERTIFICATE = re.compile(r"Accepted TLS connection on \S+: (?P<address>\S+)\. Common Name: (?P<name>.+)\.$")
ACCEPTED = re.compile(r"New transport link accepted from (?P<zid>[0-9a-f]+) to .*?dst: tls/(?P<address>[^,]+),")
CACHING_LINES = 9  # log lines about computing the access rights of a new key in one direction; they are no refusals
HANDSHAKE_FAULTS = (  # text in the log of zenoh or rustls, reason of the refusal
    ("Invalid password", "wrong password"),
    ("UsrPwd extension", "no password"),
    ("peer sent no certificates", "no certificate"),
    ("invalid peer certificate", "certificate of another authority, or expired"),
    ("InvalidContentType", "no TLS"),
    ("Timeout during TLS handshake", "no TLS handshake in time"),
)
NAMES = frozenset(topic.name for topic in TOPICS) | frozenset(query.name for query in QUERIES)
MAX_NAMES = 1000  # repeated connections from new addresses must not fill memory


@dataclass(frozen=True)
class Refusal:
    """A message or connection that the router refused."""

    reason: str  # refusals are counted by it
    name: str = ""  # on the certificate; empty if unknown
    key: str = ""


@dataclass
class ZenohLogParser:
    """Finds refusals in zenoh's log, line by line."""

    _names: dict[str, str] = field(default_factory=dict)  # certificate names, by address, then by session id
    _last_name: str = ""  # on the certificate presented last
    _caching: dict[str, int] = field(default_factory=dict)  # by thread: number of following lines to ignore

    def read(self, line: str) -> Refusal | str | None:
        """Reads a line; returns a refusal, the text of another error or warning, or None for any other line."""
        plain = COLOUR.sub("", line).rstrip()
        match = LINE.match(plain)
        if match is None:
            return plain or None
        thread, target, text = match["thread"], match["target"], match["text"].split(" at /", maxsplit=1)[0]
        if target.endswith("access_control"):
            return self._read_access_line(thread, text)
        if (certificate := CERTIFICATE.match(text)) is not None:
            self._store_name(certificate["address"], certificate["name"])
            self._last_name = certificate["name"]
        elif (accepted := ACCEPTED.match(text)) is not None:
            self._store_name(accepted["zid"], self._names.pop(accepted["address"], ""))
        elif reason := next((reason for words, reason in HANDSHAKE_FAULTS if words in text), ""):
            return Refusal(reason, self._last_name if "password" in reason else "")
        elif match["level"] in {"ERROR", "WARN"} and "handshake eof" not in text:  # eof: a port scan or health check
            return plain
        return None

    def _read_access_line(self, thread: str, text: str) -> Refusal | None:
        """Reads a line of zenoh's access control; returns a refusal, or None if the line is about something else."""
        if "caching permissions" in text:
            self._caching[thread] = CACHING_LINES
            return None
        if not text.startswith("Using cached result") and self._caching.get(thread, 0):
            self._caching[thread] -= 1
            return None
        denied = DENIED.search(text)
        if denied is None or denied["flow"] != "ingress":
            return None
        return Refusal(denied["action"].lower(), self._names.get(denied["zid"], ""), denied["key"])

    def _store_name(self, address_or_zid: str, name: str) -> None:
        if len(self._names) >= MAX_NAMES:
            self._names.clear()
        self._names[address_or_zid] = name


class Refusals:
    """Counts refusals by reason, and logs each combination of reason, name and topic at most once a second."""

    def __init__(self, log: Logger) -> None:
        """Logs to ``log``."""
        self.counts: Counter[str] = Counter()  # by reason
        self._log, self._may_log, self._parser = log, LogRateLimiter(), ZenohLogParser()

    def process_line(self, line: str) -> None:
        """Processes one line of zenoh's log."""
        found = self._parser.read(line)
        if isinstance(found, str):
            self._log.warning("zenoh", said=found)
        elif found is not None:
            self.counts[found.reason] += 1
            # Only known topics, because a peer may invent keys.
            topic = next((name for name in found.key.split("/")[2:3] if name in NAMES), "")
            if self._may_log(f"{found.reason} {found.name} {topic}"):
                named = {name: value for name, value in (("name", found.name), ("key", found.key)) if value}
                self._log.warning("refused", reason=found.reason, **named, so_far=self.counts[found.reason])


@contextmanager
def capture_zenoh_log(refusals: Refusals) -> Iterator[None]:
    """Passes zenoh's log, which it writes to standard output, to ``refusals`` until the block ends.

    The process must not print to standard output during this time.
    """
    if os.environ.pop("RUST_LOG", None):
        refusals._log.warning("RUST_LOG is ignored, because refusals are read from zenoh's log")  # noqa: SLF001
    original_stdout, (reading, writing) = os.dup(1), os.pipe()
    os.dup2(writing, 1)
    os.close(writing)

    def read() -> None:
        with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                refusals.process_line(line)

    thread = threading.Thread(target=read, name="refusals", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(original_stdout, 1)  # closes the pipe's last writing end, so the thread reads the rest and ends
        os.close(original_stdout)
        thread.join(timeout=5)
