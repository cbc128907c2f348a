"""Splits a long recording into files that each stand alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from common.errors import UserError
from common.messages.topics import Topic
from services.recorder.files.writer import RecordingWriter

Ending = Callable[[], Mapping[str, Mapping[str, str]]]  # returns metadata records by name


@dataclass(frozen=True)
class PartLimits:
    """Limits of one part. 0 means no limit."""

    size: int = 0  # bytes
    seconds: float = 0.0  # between the reception of the first and the last message


class PartsWriter:
    """Writes one file after another and repeats metadata and attachments in each.

    Methods have the meaning and errors of those of `RecordingWriter`; `finish` returns all files.
    """

    def __init__(
        self,
        first: RecordingWriter,
        open_part: Callable[[int], RecordingWriter],
        limits: PartLimits,
        ending: Ending = dict,
    ) -> None:
        """Starts with the part ``first``; ``open_part`` opens later ones by their numbers from 2.

        ``ending`` returns the metadata records that are written at the end of each part.
        """
        self._open, self._limits, self._ending = open_part, limits, ending
        self._metadata: dict[str, dict[str, str]] = {}  # by name; the last record of each name
        self._attachments: dict[str, tuple[bytes, str, int]] = {}
        self._channels: dict[str, Topic] = {}  # by key
        self._began_ns: int | None = None  # when the part's first message was received
        self._saved_before = 0  # messages in completed parts
        self._repeated = 0  # bytes of this part that each part repeats; they do not count for its size
        self.finished: list[Path] = []
        self.part = first

    @property
    def failed(self) -> bool:
        """Whether writing the current part has failed."""
        return self.part.failed

    @property
    def saved(self) -> int:
        """Number of messages in all parts that are safely in the file."""
        return self._saved_before + self.part.saved

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Writes a named map of text to this part and to all later ones."""
        self._metadata[name] = values
        self.part.metadata(name, values)

    def attachment(self, name: str, data: bytes, media_type: str, time_ns: int) -> None:
        """Attaches a file to this part and to all later ones."""
        self._attachments[name] = data, media_type, time_ns
        self.part.attachment(name, data, media_type, time_ns)
        self._repeated += len(data)

    def declare(self, topic: Topic, key: str) -> None:
        """Declares the channel of a key in this part and in all later ones."""
        self._channels[key] = topic
        self.part.declare(topic, key)

    def write(self, topic: Topic, key: str, payload: bytes, published_ns: int, received_ns: int) -> None:
        """Writes one payload unchanged. Times are wall times in ns."""
        if self._is_over(received_ns):
            self._next()
        if self._began_ns is None:
            self._began_ns = received_ns
        self._channels.setdefault(key, topic)
        self.part.write(topic, key, payload, published_ns, received_ns)

    def flush(self) -> None:
        """Hands all messages so far to the operating system, so that they survive the end of this process."""
        self.part.flush()

    def finish(self) -> list[Path]:
        """Completes the last part and returns the paths of all parts, without a failed one that holds no message."""
        if not self.part.failed:
            self._write_ending()
        path = self.part.finish()
        return [*self.finished, path] if path.exists() else self.finished

    def _is_over(self, now_ns: int) -> bool:
        limits, began = self._limits, self._began_ns
        if began is None:
            return False  # each part has at least one message
        large = limits.size and self.part.size - self._repeated >= limits.size
        return bool(large or (limits.seconds and now_ns - began >= limits.seconds * 1e9))

    def _next(self) -> None:
        number = len(self.finished) + 2
        following = self._open(number)  # opened first: if that fails, the current part can still be completed
        try:
            self._write_ending()
            before = self.part.finish()
        except UserError:
            following.discard()
            raise
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
        self._repeated = self.part.size

    def _write_ending(self) -> None:
        for name, values in self._ending().items():
            self.part.metadata(name, dict(values))
