"""One MCAP file: payloads as sent, schemas derived from the messages."""

from __future__ import annotations

import fcntl
import json
import os
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path

from common.errors import UserError
from common.messages.topics import Topic
from services.recorder.files.chunks import mcap_writer

PROFILE = "presage"
LIBRARY = "presage recorder"
UNFINISHED_SUFFIX = ".active"  # behind the name of a file that is not complete


class NameTakenError(UserError):
    """A recording of that name is there, or being written."""


class RecordingWriter:
    """Writes NAME.mcap.active, which becomes NAME.mcap at `finish`; every step raises UserError where it fails."""

    def __init__(self, path: Path, compression: str = "zstd", chunk_size: int = 1 << 18) -> None:
        """Open the file; raises UserError where that cannot be, `NameTakenError` where the name is another's."""
        self.path, self.active = path, path.with_name(path.name + UNFINISHED_SUFFIX)
        self.written: Counter[str] = Counter()  # by key
        self.failed = False
        self._saved = 0
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = claim(path, self.active)
        except OSError as error:
            raise UserError(f"{path.parent}: cannot be written to ({error.strerror}); choose another folder") from None
        self._writer, self._chunk = mcap_writer(self._stream, compression, chunk_size)
        self._guarded(lambda: self._writer.start(PROFILE, LIBRARY))

    @property
    def size(self) -> int:
        """Bytes that lie in the file so far; what is not flushed is not counted."""
        return self._stream.tell()

    @property
    def saved(self) -> int:
        """Messages, at least, that are in complete chunks which the system has: they survive a failure to write on."""
        return self._saved

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """A named map of text."""
        self._guarded(lambda: self._writer.add_metadata(name, values))

    def attachment(self, name: str, data: bytes, media_type: str, time_ns: int) -> None:
        """A file inside the file."""
        self._guarded(lambda: self._writer.add_attachment(time_ns, time_ns, name, media_type, data))

    def declare(self, topic: Topic, key: str) -> int:
        """The channel of a key, with the JSON schema derived from its message; registered once."""
        if key not in self._channels:
            name = topic.message.__name__
            if name not in self._schemas:
                schema = json.dumps(topic.message.json_schema()).encode()
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", schema)
            about = {"topic": topic.name, "robot": key.split("/")[1]}
            self._channels[key] = self._writer.register_channel(key, "msgpack", self._schemas[name], about)
        return self._channels[key]

    def write(self, topic: Topic, key: str, payload: bytes, published_ns: int, received_ns: int) -> None:
        """One payload, exactly as it came; times in ns of the wall clock."""

        def add() -> None:
            self._writer.add_message(
                self.declare(topic, key),
                log_time=received_ns,
                data=payload,
                publish_time=published_ns,
                sequence=(self.written[key] - 1) & 0xFFFFFFFF,
            )

        self.written[key] += 1
        self._guarded(add)
        if not self._chunk.num_messages:  # that was the last message of a chunk
            self._guarded(self._stream.flush)
            self._saved = self.written.total()

    def flush(self) -> None:
        """Complete the chunk and hand it to the system: what came before survives this process."""
        self._guarded(self._writer.flush)
        self._saved = self.written.total()
        if not is_there(self.active, self._stream):
            self.failed = True
            raise UserError(
                f"{self.active}: was removed or moved away while it was written: what it held is gone with it; "
                "start recording anew"
            )

    def finish(self) -> Path:
        """Complete the file and give it its name; after a failure only close it, unfinished."""

        def end() -> None:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self.active.rename(self.path)  # while it is locked: nobody else has taken it
            self._stream.close()

        if self.failed:
            self._abandon()
            return self.active
        self._guarded(self._writer.flush)
        self._saved = self.written.total()
        self._guarded(end)
        return self.path

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except OSError as error:
            self.failed = True
            why = error.strerror or str(error)
            raise UserError(
                f"{self.active}: recording failed ({why}); what was flushed before is in the file, and "
                f"`presage recover {self.active}` makes a whole one of it: make room, or choose another folder"
            ) from None

    def _abandon(self) -> None:
        try:
            self._stream.close()
        except OSError:
            self._stream.raw.close()  # what is still in the buffer cannot be written


def is_there(path: Path, stream: BufferedWriter) -> bool:
    """Whether the file that is open still has that name."""
    try:
        named, opened = path.stat(), os.fstat(stream.fileno())
    except OSError:
        return False
    return (named.st_dev, named.st_ino) == (opened.st_dev, opened.st_ino)


def is_being_written(path: Path) -> bool:
    """Whether a live process holds this unfinished file; the lock ends with the process, however it ends."""
    try:
        with path.open("rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # gone, or a file system without locks
        return False
    return False


def claim(path: Path, active: Path, remedy: str = "--file") -> BufferedWriter:
    """The unfinished file, open; whoever makes it owns the name, so two recorders never write one recording."""
    taken = f"is there already; choose another name with {remedy}, or another folder"
    try:
        stream = active.open("xb")
        with suppress(OSError):  # some network file systems have no locks
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileExistsError:
        raise NameTakenError(f"{active}: {taken}") from None
    if path.exists():
        stream.close()
        active.unlink()
        raise NameTakenError(f"{path}: {taken}")
    return stream
