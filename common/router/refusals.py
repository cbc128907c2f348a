"""Counts and logs connections that the router refused, read from zenoh's log.

Tells apart what zenoh 1.10 tells apart. Messages are named with the certificate's name, key and kind; a wrong password
with the name on the certificate shown last; who shows no good certificate has no name. What a session does not even
send, because nobody listens to it, is seen by nobody.
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

# Level error, as everywhere, and those lines that tell of refusals.
LOG_FILTER = (
    "error,zenoh::api::session=off,zenoh::net::protocol::gossip=off,zenoh::net::routing::hat=off,"
    "zenoh::net::routing::interceptor::access_control=trace,"
    "zenoh_transport::unicast::establishment::accept=debug,zenoh_link_tls::unicast=debug"
)
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
LINE = re.compile(r"^\S+Z +(?P<level>[A-Z]+) .*?(?P<thread>ThreadId\(\d+\)) (?P<target>\S+): (?P<text>.*)$")
DENIED = re.compile(
    r"(?P<zid>[0-9a-f]+)(?: on \S+)? is unauthorized to (?P<what>.+?) \((?P<flow>\w+)\) on (?P<key>\S+)"
)
SHOWN = re.compile(r"Accepted TLS connection on \S+: (?P<address>\S+)\. Common Name: (?P<name>.+)\.$")
LET_IN = re.compile(r"New transport link accepted from (?P<zid>[0-9a-f]+) to .*?dst: tls/(?P<address>[^,]+),")
PLANNED = 9  # lines in which zenoh works out a new key's rights in one direction, before any message
HANDSHAKES = (  # of zenoh's and rustls' words
    ("Invalid password", "wrong password"),
    ("UsrPwd extension", "no password"),
    ("peer sent no certificates", "no certificate"),
    ("invalid peer certificate", "certificate of another authority, or expired"),
    ("InvalidContentType", "no TLS"),
    ("Timeout during TLS handshake", "no TLS handshake in time"),
)
NAMES = frozenset(topic.name for topic in TOPICS) | frozenset(query.name for query in QUERIES)
MOST_NAMES = 1000  # a stranger who comes again and again must not fill memory


@dataclass(frozen=True)
class Refusal:
    """One thing that was not let through."""

    why: str  # what it is counted under
    who: str = ""  # name on the certificate
    key: str = ""


@dataclass
class ZenohLogParser:
    """Makes sense of zenoh's log, line by line."""

    _names: dict[str, str] = field(default_factory=dict)  # by address, then by zenoh's id
    _last: str = ""
    _planned: dict[str, int] = field(default_factory=dict)  # by thread, lines that are no refusals yet to come

    def read(self, line: str) -> Refusal | str | None:
        """A refusal; what zenoh has to say besides; or None."""
        plain = COLOUR.sub("", line).rstrip()
        match = LINE.match(plain)
        if match is None:
            return plain or None
        thread, target, text = match["thread"], match["target"], match["text"].split(" at /", maxsplit=1)[0]
        if target.endswith("access_control"):
            return self._access(thread, text)
        if (shown := SHOWN.match(text)) is not None:
            self._remember(shown["address"], shown["name"])
            self._last = shown["name"]
        elif (let_in := LET_IN.match(text)) is not None:
            self._remember(let_in["zid"], self._names.pop(let_in["address"], ""))
        elif why := next((why for words, why in HANDSHAKES if words in text), ""):
            return Refusal(why, self._last if "password" in why else "")
        elif match["level"] in {"ERROR", "WARN"} and "handshake eof" not in text:  # somebody looked whether we listen
            return plain
        return None

    def _access(self, thread: str, text: str) -> Refusal | None:
        if "caching permissions" in text:
            self._planned[thread] = PLANNED
            return None
        if not text.startswith("Using cached result") and self._planned.get(thread, 0):
            self._planned[thread] -= 1
            return None
        denied = DENIED.search(text)
        if denied is None or denied["flow"] != "ingress":
            return None
        return Refusal(denied["what"].lower(), self._names.get(denied["zid"], ""), denied["key"])

    def _remember(self, what: str, name: str) -> None:
        if len(self._names) >= MOST_NAMES:
            self._names.clear()
        self._names[what] = name


class Refusals:
    """Counts, and a line a second at most of each kind, name and topic."""

    def __init__(self, log: Logger) -> None:
        """Nothing yet."""
        self.counts: Counter[str] = Counter()  # by why
        self._log, self._may_log, self._reader = log, LogRateLimiter(), ZenohLogParser()

    def take(self, line: str) -> None:
        """One line of zenoh's log."""
        found = self._reader.read(line)
        if isinstance(found, str):
            self._log.warning("zenoh", said=found)
        elif found is not None:
            self.counts[found.why] += 1
            topic = next(
                (name for name in found.key.split("/")[2:3] if name in NAMES), ""
            )  # keys are anybody's to invent
            if self._may_log(f"{found.why} {found.who} {topic}"):
                named = {name: value for name, value in (("who", found.who), ("key", found.key)) if value}
                self._log.warning("refused", why=found.why, **named, so_far=self.counts[found.why])


@contextmanager
def listening_to_zenoh(refusals: Refusals) -> Iterator[None]:
    """Zenoh logs to standard output: for the block it is ours to read. The process must not print."""
    if os.environ.pop("RUST_LOG", None):
        refusals._log.warning("RUST_LOG is not heeded: zenoh's log is where refusals are read")  # noqa: SLF001
    kept, (reading, writing) = os.dup(1), os.pipe()
    os.dup2(writing, 1)
    os.close(writing)

    def read() -> None:
        with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                refusals.take(line)

    thread = threading.Thread(target=read, name="refusals", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(kept, 1)  # the last writing end: the thread reads what is left, and ends
        os.close(kept)
        thread.join(timeout=5)
