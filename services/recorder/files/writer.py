"""One MCAP file: payloads as sent, schemas derived from the messages."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path

from common.errors import UserError
from common.messages.topics import Topic
from services.recorder.files.chunks import CHUNK_BYTES, mcap_writer

if sys.platform != "win32":
    import fcntl

PROFILE = "presage"
LIBRARY = "presage recorder"
UNFINISHED_SUFFIX = ".active"  # appended to the name until the file is complete


class NameTakenError(UserError):
    """A recording of that name exists or is being written."""

    def __init__(self, path: Path, remedy: str = "--file") -> None:
        """``path`` is the file that is there, ``remedy`` the option that chooses another name."""
        super().__init__(f"{path}: is there already; choose another name with {remedy}, or another folder")


class RecordingWriter:
    """Writes NAME.mcap.active, which `finish` renames to NAME.mcap. Every method raises UserError if writing fails."""

    def __init__(self, path: Path, compression: str = "zstd", chunk_size: int = CHUNK_BYTES) -> None:
        """Opens the file. Raises UserError if that fails, and NameTakenError if the name is taken."""
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
        """Bytes in the file so far, without those that are not yet flushed."""
        return self._stream.tell()

    @property
    def saved(self) -> int:
        """Number of messages in complete chunks that were handed to the operating system; they survive later errors."""
        return self._saved

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Writes a named map of text."""
        self._guarded(lambda: self._writer.add_metadata(name, values))

    def attachment(self, name: str, data: bytes, media_type: str, time_ns: int) -> None:
        """Attaches a file."""
        self._guarded(lambda: self._writer.add_attachment(time_ns, time_ns, name, media_type, data))

    def declare(self, topic: Topic, key: str) -> int:
        """Registers the channel of a key once, with the JSON schema of its message. Returns the channel id."""
        if key not in self._channels:
            name = topic.message.__name__
            if name not in self._schemas:
                schema = json.dumps(topic.message.json_schema()).encode()
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", schema)
            about = {"topic": topic.name, "robot": key.split("/")[1]}
            self._channels[key] = self._writer.register_channel(key, "msgpack", self._schemas[name], about)
        return self._channels[key]

    def write(self, topic: Topic, key: str, payload: bytes, published_ns: int, received_ns: int) -> None:
        """Writes one payload unchanged. Times are wall times in ns."""

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
        if not self._chunk.num_messages:  # the chunk was completed by this message
            self._guarded(self._stream.flush)
            self._saved = self.written.total()

    def flush(self) -> None:
        """Completes the chunk and hands it to the operating system, so that it survives the end of this process."""
        self._guarded(self._writer.flush)
        self._saved = self.written.total()
        if not is_there(self.active, self._stream):
            self.failed = True
            raise UserError(
                f"{self.active}: was removed or moved while it was being written, and its messages are lost; "
                "start a new recording"
            )

    def finish(self) -> Path:
        """Completes and renames the file, and returns its path.

        After a failure, only closes the unfinished file, or removes it if no message is in it.
        """

        def end() -> None:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fsync(self._stream.fileno())
            if sys.platform == "win32":  # which renames only closed files
                self._stream.close()
            self.active.rename(self.path)  # before closing, which releases the lock
            self._stream.close()

        if self.failed:
            if self._saved:
                self._close()
            else:
                self.discard()
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
            reason, advice = error.strerror or str(error), "free some space, or choose another folder"
            saved = (
                f"the messages flushed before are in the file, and `presage recover {self.active}` completes it"
                if self._saved
                else "it holds no message"
            )
            raise UserError(f"{self.active}: recording failed ({reason}); {saved}: {advice}") from None

    def discard(self) -> None:
        """Closes and removes the unfinished file."""
        self.failed = True
        there = is_there(self.active, self._stream)
        self._close()
        if there:
            self.active.unlink()

    def _close(self) -> None:
        try:
            self._stream.close()
        except OSError:
            self._stream.raw.close()  # the rest of the buffer cannot be written


def is_there(path: Path, stream: BufferedWriter) -> bool:
    """Whether ``path`` still names the open file ``stream``."""
    try:
        named, opened = path.stat(), os.fstat(stream.fileno())
    except OSError:
        return False
    return (named.st_dev, named.st_ino) == (opened.st_dev, opened.st_ino)


def is_being_written(path: Path) -> bool:
    """Whether a running process is writing this file; unknown, and so False, on Windows.

    The lock is released whenever that process ends.
    """
    if sys.platform != "win32":
        try:
            with path.open("rb") as stream:
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # the file is gone, or the file system has no locks
            return False
    return False


def claim(path: Path, active: Path, remedy: str = "--file") -> BufferedWriter:
    """Creates and locks the unfinished file ``active``, and returns it open for writing.

    Creation is exclusive, so two recorders never write to one recording. Raises NameTakenError if ``active`` or
    ``path`` exists; the message names the option ``remedy``.
    """
    try:
        stream = active.open("xb")
        if sys.platform != "win32":
            with suppress(OSError):  # some network file systems have no locks
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileExistsError:
        raise NameTakenError(active, remedy) from None
    if path.exists():
        stream.close()
        active.unlink()
        raise NameTakenError(path, remedy)
    return stream
