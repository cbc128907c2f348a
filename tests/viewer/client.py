"""A visitor without a browser, written only from the description of the protocol."""

from __future__ import annotations

import itertools
import json
import struct
import time
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import numpy as np
from websockets.sync.client import connect

from tests.conftest import WAIT_TIMEOUT_S


@dataclass(frozen=True)
class Frame:
    """A binary message: header, arrays by name, and all bytes."""

    header: dict
    arrays: dict = field(repr=False)
    data: bytes = field(repr=False)


def read_frame(data: bytes) -> Frame:
    """Decodes a binary message."""
    (length,) = struct.unpack_from("<I", data)
    assert (4 + length) % 4 == 0
    header = json.loads(data[4 : 4 + length], parse_constant=no_json)
    floats = np.frombuffer(data, "<f4", offset=4 + length)
    arrays = {name: floats[offset : offset + count] for name, (offset, count) in header["arrays"].items()}
    assert sum(map(len, arrays.values())) == len(floats)
    return Frame(header, arrays, data)


def is_complete(header):
    """Whether a frame shows the answers to its scan; a busy machine sends frames before all of them have arrived."""
    answered = header["belief"] and header["belief"]["stamp_ns"] == header["stamp_ns"] and header["error"] is not None
    return answered and header["arrays"]["predicted"][1] > 0


def kind_of(message):
    return (message.header if isinstance(message, Frame) else message)["type"]


def no_json(name):
    raise AssertionError(f"{name} is no JSON")


def page_of(running, timeout=WAIT_TIMEOUT_S):
    """The link that a viewer printed."""
    running.wait_for("page: ", timeout)
    return next(line for line in running.output.splitlines() if line.startswith("page: ")).removeprefix("page: ")


class Page:
    """A visitor with an open web socket."""

    def __init__(self, link, origin=None, **options):
        parts = urlsplit(link)
        query = f"?{parts.query}" if parts.query else ""
        waits = {"open_timeout": WAIT_TIMEOUT_S, "ping_timeout": WAIT_TIMEOUT_S, "close_timeout": 2}
        # Like a browser, it reads whatever comes: otherwise pings are not answered, and the server closes the socket.
        options = {"compression": None, "max_size": None, "max_queue": None, **waits, **options}
        origin = origin or f"http://{parts.netloc}"
        self.socket = connect(f"ws://{parts.netloc}/ws{query}", origin=origin, **options).__enter__()
        self.numbers = itertools.count(1)
        self.last = {}  # by type

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def next(self, timeout=WAIT_TIMEOUT_S):
        """The next message: a Frame, or a dict."""
        data = self.socket.recv(timeout)
        message = read_frame(data) if isinstance(data, bytes) else json.loads(data)
        self.last[kind_of(message)] = message
        return message

    def until(self, wanted, timeout=WAIT_TIMEOUT_S):
        """The first message that meets a condition."""
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            try:
                message = self.next(left)
            except TimeoutError:
                break
            if wanted(message):
                return message
        last = "\n".join(f"{kind}: {str(message)[:600]}" for kind, message in self.last.items())
        raise AssertionError(f"nothing as wanted within {timeout:g} s; the last were\n{last}")

    def wait_for(self, kind, wanted=lambda _: True, timeout=WAIT_TIMEOUT_S):
        """The next message of a type that meets a condition."""
        return self.until(lambda m: kind_of(m) == kind and wanted(m), timeout)

    def by_now(self, kind, wanted, timeout=WAIT_TIMEOUT_S):
        """Like `wait_for`, but also accepts the last message that was already received."""
        last = self.last.get(kind)
        if last is not None and wanted(last):
            return last
        return self.wait_for(kind, wanted, timeout)

    def frame(self, wanted=lambda _: True, timeout=WAIT_TIMEOUT_S):
        """The next frame whose header meets a condition."""
        return self.wait_for("frame", lambda m: wanted(m.header), timeout)

    def request(self, do, timeout=WAIT_TIMEOUT_S, **fields):
        """Requests an action and returns the answer."""
        number = next(self.numbers)
        self.socket.send(json.dumps({"id": number, "do": do, **fields}))
        return self.wait_for("answer", lambda m: m["id"] == number, timeout)

    def done(self, do, **fields):
        """Like `request`, and asserts success."""
        answer = self.request(do, **fields)
        assert answer["ok"], answer
        return answer
