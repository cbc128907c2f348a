"""Splits a long recording into files that each stand alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from common.messages.topics import Topic
from services.recorder.files.writer import RecordingWriter

Ending = Callable[[], Mapping[str, Mapping[str, str]]]


@dataclass(frozen=True)
class Limits:
    """Of one part; 0 is none."""

    size: int = 0  # bytes
    seconds: float = 0.0  # between the reception of its first message and its last


class PartsWriter:
    """Writes one file after another; what was said of the session is said again in each. Raises as RecordingWriter."""

    def __init__(self, open_part: Callable[[int], RecordingWriter], limits: Limits, ending: Ending = dict) -> None:
        """Open the first part, number 1; ``ending`` gives the metadata records that stand at each part's end."""
        self._open, self._limits, self._ending = open_part, limits, ending
        self._metadata: dict[str, dict[str, str]] = {}  # of each name the last
        self._attachments: dict[str, tuple[bytes, str, int]] = {}
        self._channels: dict[str, Topic] = {}  # by key
        self._began_ns: int | None = None  # reception of the part's first message
        self._saved_before = 0  # messages in parts that are complete
        self.finished: list[Path] = []
        self.part = open_part(1)

    @property
    def failed(self) -> bool:
        """Whether the part that is open cannot be written any more."""
        return self.part.failed

    @property
    def saved(self) -> int:
        """Messages in all parts that are there whatever happens now."""
        return self._saved_before + self.part.saved

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """A named map of text, in this part and in those to come."""
        self._metadata[name] = values
        self.part.metadata(name, values)

    def attachment(self, name: str, data: bytes, media_type: str, time_ns: int) -> None:
        """A file inside the file, in this part and in those to come."""
        self._attachments[name] = data, media_type, time_ns
        self.part.attachment(name, data, media_type, time_ns)

    def declare(self, topic: Topic, key: str) -> None:
        """The channel of a key, in this part and in those to come."""
        self._channels[key] = topic
        self.part.declare(topic, key)

    def write(self, topic: Topic, key: str, payload: bytes, published_ns: int, received_ns: int) -> None:
        """One payload, exactly as it came; times in ns of the wall clock."""
        if self._is_over(received_ns):
            self._next()
        if self._began_ns is None:
            self._began_ns = received_ns
        self._channels.setdefault(key, topic)
        self.part.write(topic, key, payload, published_ns, received_ns)

    def flush(self) -> None:
        """What came before survives this process."""
        self.part.flush()

    def finish(self) -> list[Path]:
        """Complete the last part; all of them."""
        if not self.part.failed:
            self._write_ending()
        self.finished.append(self.part.finish())
        return self.finished

    def _is_over(self, now_ns: int) -> bool:
        limits, began = self._limits, self._began_ns
        if began is None:
            return False  # a part has one message at least
        large = limits.size and self.part.size >= limits.size
        return bool(large or (limits.seconds and now_ns - began >= limits.seconds * 1e9))

    def _next(self) -> None:
        number = len(self.finished) + 2
        following = self._open(number)  # first: where that fails, this part still can be completed
        self._write_ending()
        before = self.part.finish()
        self.finished.append(before)
        self._saved_before += self.part.saved
        self.part, self._began_ns = following, None
        for name, values in self._metadata.items():
            self.part.metadata(name, values)
        self.part.metadata("part", {"number": str(number), "previous": before.name})
        for name, (data, media_type, time_ns) in self._attachments.items():
            self.part.attachment(name, data, media_type, time_ns)
        for key, topic in self._channels.items():
            self.part.declare(topic, key)
        self.part.flush()

    def _write_ending(self) -> None:
        for name, values in self._ending().items():
            self.part.metadata(name, dict(values))
