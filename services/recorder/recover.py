"""Rebuilds a complete file from a damaged or unfinished one.

mcap's readers stop at the first damaged record; here reading resumes after it.
"""

from __future__ import annotations

import mmap
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from common.errors import UserError
from services.recorder.files.chunks import MAGIC, PREFIX, mcap_writer, unpacked_records
from services.recorder.files.index import summary_of
from services.recorder.files.message_counts import MessageCounts, as_metadata
from services.recorder.files.writer import PROFILE, UNFINISHED_SUFFIX, claim, is_being_written

INCOMPLETE_SUFFIX = ".incomplete"  # appended to the name of an unfinished source file after recovery
# Where reading may resume after damage: the prefix of a chunk, an attachment or metadata shorter than 2^40 bytes.
RECORD_START = re.compile(rb"[\x06\x09\x0c](?=.{5}\x00\x00\x00)", re.DOTALL)


@dataclass(frozen=True)
class DamagedRange:
    """A range of bytes that could not be read."""

    offset: int
    length: int


@dataclass
class RecoveryResult:
    """Result of a recovery."""

    source: Path
    path: Path
    size: int  # bytes of the source
    chunks: int = 0
    messages: Counter[str] = field(default_factory=Counter)  # by key
    start_ns: int | None = None
    end_ns: int | None = None
    skipped: int = 0  # messages in intact chunks whose channel declaration is lost
    damages: list[DamagedRange] = field(default_factory=list)
    altered: bool = False  # no chunk or length is damaged, but the file's checksum is wrong
    source_finished: bool = False  # the source file was finished: only the damaged parts are missing
    message_counts: MessageCounts = field(default_factory=MessageCounts)

    def lines(self) -> list[str]:
        """Lines of a report for the user."""
        seconds = ((self.end_ns or 0) - (self.start_ns or 0)) * 1e-9
        lines = [f"{self.path}: {self.messages.total()} messages over {seconds:.1f} s, from {self.chunks} chunks"]
        for damage in self.damages:
            where = "at its end" if damage.offset + damage.length == self.size else f"from byte {damage.offset}"
            lines.append(f"missing: {damage.length} bytes {where} are not a complete chunk")
        if self.skipped:
            lines.append(f"missing: {self.skipped} messages whose channels are declared only in the damaged part")
        if self.altered:
            lines.append("altered: metadata or indexes, outside of the chunks; the file's checksum does not show where")
        if not self.source_finished:
            lines.append("missing: the end of the file; messages after the last flush were never written")
        lines += [
            f"missing: {numbers.missing} messages of {key} by their sequence numbers, in {numbers.gaps} gaps"
            for key in self.messages
            if (numbers := self.message_counts.sequence_totals(key)).missing
        ]
        return lines


def recover(
    source: Path, path: Path | None = None, *, on_progress: Callable[[float], None] = lambda _: None
) -> RecoveryResult:
    """Writes the readable part of ``source`` to ``path``, which defaults to `target_of`.

    An unfinished source (.mcap.active) is renamed to .mcap.incomplete. Raises UserError if the source is still being
    written, if no message can be recovered, or if the target exists.
    """
    path = path or target_of(source)
    try:
        stream = source.open("rb")
    except OSError as error:
        raise UserError(f"{source}: cannot be read ({error.strerror})") from None
    with stream:
        if is_being_written(source):
            raise UserError(f"{source}: is being written by a running recorder; stop it first")
        if source.stat().st_size == 0:
            raise UserError(f"{source}: is empty, there is nothing to recover: it can be removed")
        declared = _declared(stream)
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                found = _copy(data, RecoveryResult(source, path, len(data)), declared, on_progress)
            except OSError as error:
                problem = f"cannot be written ({error.strerror}); free some space, or choose another file with --out"
                raise UserError(f"{path}: {problem}") from None
    if source.name.endswith(UNFINISHED_SUFFIX):
        source.rename(source.with_name(source.name.removesuffix(UNFINISHED_SUFFIX) + INCOMPLETE_SUFFIX))
    return found


def target_of(source: Path) -> Path:
    """Default path of the recovered file."""
    if source.name.endswith(UNFINISHED_SUFFIX):
        return source.with_name(source.name.removesuffix(UNFINISHED_SUFFIX))
    return source.with_name(source.name.split(".mcap")[0] + "-recovered.mcap")


def _declared(stream: BinaryIO) -> list[Schema | Channel]:
    """Schemas and channels in the file's summary. Returns an empty list if there is no valid summary."""
    try:
        summary = summary_of(stream)
    except Exception:  # noqa: BLE001 - a damaged summary can raise any error
        return []
    return [] if summary is None else [*summary.schemas.values(), *summary.channels.values()]


def _copy(
    data: mmap.mmap, found: RecoveryResult, declared: list[Schema | Channel], on_progress: Callable[[float], None]
) -> RecoveryResult:
    active = found.path.with_name(found.path.name + ".recovering")
    if not is_being_written(active):  # left by an interrupted recovery
        active.unlink(missing_ok=True)
    stream = claim(found.path, active, remedy="--out")
    try:
        copier = _Copier(stream, found, declared)
        for records, end in _walk(data, found):
            for record in records:
                copier.copy(record)
            on_progress(end / found.size)
        copier.finish()
        stream.close()
        active.rename(found.path)
    finally:
        active.unlink(missing_ok=True)
        with suppress(OSError):  # the disk may be full, so flushing the buffer may fail too
            stream.close()
    return found


class _Copier:
    """Copies records of one file to another."""

    def __init__(self, stream: BinaryIO, found: RecoveryResult, declared: list[Schema | Channel]) -> None:
        """Writes to ``stream``. ``declared`` are the summary's declarations, in case their chunks are damaged."""
        self._writer, _ = mcap_writer(stream, "zstd", 1 << 18)
        self._found, self._declared = found, declared
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self._keys: dict[int, str] = {}
        self._started = False

    def copy(self, record: McapRecord) -> None:
        """Copies one record. Skips indexes and statistics, which the writer generates itself."""
        if not self._started:
            header = record if isinstance(record, Header) else Header(PROFILE, "presage recover")
            self._writer.start(header.profile, header.library)
            self._started = True
            for each in self._declared:
                self.copy(each)
        if isinstance(record, Message):
            self._message(record)
        elif isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels and record.schema_id in self._schemas:
            self._keys[record.id] = record.topic
            self._channels[record.id] = self._writer.register_channel(
                record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, Metadata) and record.name != "counters":  # they counted the complete file
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

    def _message(self, record: Message) -> None:
        channel, found = self._channels.get(record.channel_id), self._found
        if channel is None:
            found.skipped += 1
            return
        self._writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        key = self._keys[record.channel_id]
        found.messages[key] += 1
        found.message_counts.add(key, record.data)
        found.start_ns = record.log_time if found.start_ns is None else found.start_ns
        found.end_ns = record.log_time

    def finish(self) -> None:
        """Writes the counters and a record of the recovery, and completes the file."""
        found = self._found
        if not found.messages:
            raise UserError(f"{found.source}: no message in it can be recovered: {_reason(found)}")
        lost = sum(damage.length for damage in found.damages)
        about = {"from": found.source.name, "bytes": str(found.size), "bytes_not_used": str(lost)}
        counts = found.message_counts.counts(found.messages, {}, {})
        self._writer.add_metadata("counters", as_metadata(counts))
        self._writer.add_metadata("recovered", about)
        self._writer.finish()  # type: ignore[no-untyped-call]


def _reason(found: RecoveryResult) -> str:
    """Explains why no message was recovered."""
    if found.skipped:
        return f"{found.skipped} are in whole chunks, but the declarations of their channels are damaged"
    if not found.damages:
        return "its recorder ended before it received one"
    lost = sum(damage.length for damage in found.damages)
    if lost >= found.size - len(MAGIC):
        return "not an MCAP file, or all of it is damaged"
    return f"{lost} of its {found.size} bytes are damaged or cut short"


def _walk(data: mmap.mmap, found: RecoveryResult) -> Iterator[tuple[list[McapRecord], int]]:
    """Yields the content of each intact record and its end offset. Skips damaged bytes up to the next intact record."""
    offset, size = len(MAGIC), len(data)
    while offset < size:
        records = _parse(data, offset)
        if records is None:
            following = _next_intact(data, offset)
            found.damages.append(DamagedRange(offset, following - offset))
            offset = following
            continue
        opcode, length = PREFIX.unpack_from(data, offset)
        if opcode == Opcode.DATA_END:
            found.source_finished = True
            found.altered = not found.damages and not _checksum_matches(data, offset, records[0])
            return
        offset += PREFIX.size + length
        # In a chunked file, a message outside of the chunks is a misread index record.
        if opcode == Opcode.MESSAGE and found.chunks:
            continue
        found.chunks += opcode == Opcode.CHUNK
        yield records, offset


def _parse(data: mmap.mmap, offset: int) -> list[McapRecord] | None:
    """Content of the record at ``offset``. Returns None if it is damaged or cut short.

    A record whose length, opcode or checksum is damaged differs from what mcap writes for its content.
    """
    if offset + PREFIX.size > len(data):
        return None
    opcode, length = PREFIX.unpack_from(data, offset)
    end = offset + PREFIX.size + length
    if end > len(data) or not Opcode.HEADER <= opcode <= Opcode.DATA_END:
        return None
    stored, written = data[offset:end], RecordBuilder()
    try:
        record = next(StreamReader(BytesIO(stored), skip_magic=True, emit_chunks=True).records)
        record.write(written)
        if written.end() != stored:  # type: ignore[no-untyped-call]
            return None
        return unpacked_records(record) if isinstance(record, Chunk) else [record]
    except Exception:  # noqa: BLE001 - each decompressor raises its own error types
        return None


def _checksum_matches(data: mmap.mmap, end: int, record: McapRecord) -> bool:
    """Whether the checksum of the bytes before ``end`` matches, or the file has none."""
    if not isinstance(record, DataEnd) or not record.data_section_crc:
        return True
    with memoryview(data) as view, view[:end] as before:
        return bool(zlib.crc32(before) == record.data_section_crc)


def _next_intact(data: mmap.mmap, damaged: int) -> int:
    """Offset at which reading resumes after a damaged record: the following record, or else the next one found."""
    if damaged + PREFIX.size <= len(data):
        following = damaged + PREFIX.size + int(PREFIX.unpack_from(data, damaged)[1])
        if _parse(data, following) is not None:
            return following
    for start in RECORD_START.finditer(data, damaged + 1):
        if _parse(data, start.start()) is not None:
            return start.start()
    return len(data)
