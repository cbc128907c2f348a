"""An MCAP file of a session: payloads as sent, schemas derived, unfinished files known by their name."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

from mcap.writer import CompressionType, Writer

from common.errors import UserError
from common.topics import Topic

PROFILE = "presage"
LIBRARY = "presage recorder"
COMPRESSION = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}


class RecordingWriter:
    """Writes NAME.mcap.active, which becomes NAME.mcap at `finish`."""

    def __init__(self, path: Path, compression: str = "zstd", chunk_size: int = 1 << 18) -> None:
        """Open the file; raises UserError where that cannot be."""
        self.path, self.active = path, path.with_name(path.name + ".active")
        self.written: Counter[str] = Counter()  # by key
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists() or self.active.exists():
                raise UserError(f"{path}: there is already a recording of that name; choose another with --file")
            self._stream = self.active.open("wb")
        except OSError as error:
            raise UserError(f"{path.parent}: cannot be written to ({error.strerror}); choose another folder") from None
        self._writer = Writer(self._stream, chunk_size=chunk_size, compression=COMPRESSION[compression])
        self._guarded(lambda: self._writer.start(PROFILE, LIBRARY))

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """A named map of text."""
        self._guarded(lambda: self._writer.add_metadata(name, values))

    def attachment(self, name: str, data: bytes, media_type: str, time_ns: int) -> None:
        """A file inside the file."""
        self._guarded(lambda: self._writer.add_attachment(time_ns, time_ns, name, media_type, data))

    def declare(self, topic: Topic, key: str) -> int:
        """The channel of a key, with the JSON schema derived from its message; registered once."""
        if key not in self._channels:
            message = topic.message
            if message.__name__ not in self._schemas:
                schema = json.dumps(message.json_schema()).encode()
                self._schemas[message.__name__] = self._writer.register_schema(message.__name__, "jsonschema", schema)
            meta = {"topic": topic.name, "robot": key.split("/")[1]}
            schema_id = self._schemas[message.__name__]
            self._channels[key] = self._writer.register_channel(key, "msgpack", schema_id, meta)
        return self._channels[key]

    def write(self, topic: Topic, key: str, payload: bytes, published_ns: int, received_ns: int) -> None:
        """One payload, exactly as it came."""

        def add() -> None:
            channel = self.declare(topic, key)
            self._writer.add_message(
                channel, log_time=received_ns, data=payload, publish_time=published_ns, sequence=self.written[key]
            )

        self._guarded(add)
        self.written[key] += 1

    def flush(self) -> None:
        """Complete the chunk and hand it to the system: what came before survives this process."""

        def out() -> None:
            self._writer.flush()
            self._stream.flush()

        self._guarded(out)

    def finish(self) -> Path:
        """Complete the file and give it its name."""

        def end() -> None:
            self._writer.finish()
            self._stream.close()
            self.active.rename(self.path)

        self._guarded(end)
        return self.path

    def _guarded(self, step: object) -> None:
        try:
            step()  # type: ignore[operator]
        except OSError as error:
            raise UserError(
                f"{self.active}: recording failed ({error.strerror}); what was flushed before is in the file"
            ) from None
