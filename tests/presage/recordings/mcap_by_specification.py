"""A reader of MCAP files written from the specification (mcap.dev/spec) with struct: shares nothing with package mcap.

It believes nothing: every length, offset, index, count and checksum of the file is compared with what is there.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
(HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS,
 METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END) = range(1, 16)  # fmt: skip


class Cursor:
    """Little-endian fields, one after another."""

    def __init__(self, data):
        self.data, self.at = data, 0

    def numbers(self, layout):
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def bytes(self, count):
        assert self.at + count <= len(self.data), "a length points beyond the record"
        self.at += count
        return bytes(self.data[self.at - count : self.at])

    def text(self):
        return self.bytes(self.numbers("I")[0]).decode()

    def pairs(self, key, value):
        """A map: its length in bytes, then keys and values."""
        inner, found = Cursor(self.bytes(self.numbers("I")[0])), {}
        while inner.at < len(inner.data):
            name = key(inner)
            assert name not in found, "a key stands twice in a map"
            found[name] = value(inner)
        return found

    def texts(self):
        return self.pairs(Cursor.text, Cursor.text)

    def end(self):
        assert self.at == len(self.data), "bytes are left over in a record"


@dataclass
class Contents:
    """All that is in a file."""

    profile: str = ""
    library: str = ""
    schemas: dict = field(default_factory=dict)  # id: name, encoding, data
    channels: dict = field(default_factory=dict)  # id: schema id, topic, encoding, metadata
    messages: list = field(default_factory=list)  # topic, sequence, log time, publish time, data: as they stand
    metadata: list = field(default_factory=list)  # name, map
    attachments: list = field(default_factory=list)  # name, media type, data
    chunks: int = 0

    def of(self, topic):
        return [message for message in self.messages if message[0] == topic]


def records(data, start, end):
    """Opcode, content, and where the record begins and ends."""
    at = start
    while at < end:
        opcode, length = struct.unpack_from("<BQ", data, at)
        assert opcode != 0, "opcode 0"
        assert at + 9 + length <= end, "a record is cut off"
        yield opcode, data[at + 9 : at + 9 + length], at, at + 9 + length
        at += 9 + length
    assert at == end


def unpacked(compression, data):
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    if compression == "lz4":
        return lz4.frame.decompress(data)
    assert compression == ""
    return data


class Reader:
    def __init__(self, data):
        self.data, self.contents = data, Contents()
        self.found = Counter()  # records by opcode, in the data section
        self.indexes = {}  # what a right summary must say: (opcode, where): content
        self.counts = Counter()  # messages by channel
        self.times = []

    def read(self):
        data = self.data
        assert data.startswith(MAGIC)
        assert data.endswith(MAGIC)
        footer_at = len(data) - len(MAGIC) - 9 - 20
        assert struct.unpack_from("<BQ", data, footer_at) == (FOOTER, 20)
        summary_start, offsets_start, summary_crc = struct.unpack_from("<QQI", data, footer_at + 9)
        assert 0 < summary_start < offsets_start < footer_at
        assert summary_crc == zlib.crc32(data[summary_start : footer_at + 9 + 16])
        self._data_section(summary_start)
        self._summary(summary_start, offsets_start)
        self._offsets(summary_start, offsets_start, footer_at)
        return self.contents

    def _data_section(self, end):
        pending = {}  # message indexes that must follow the chunk before them
        chunk = None
        for number, (opcode, content, start, stop) in enumerate(records(self.data, len(MAGIC), end)):
            cursor = Cursor(content)
            assert (number == 0) == (opcode == HEADER)
            if opcode != MESSAGE_INDEX:
                assert not pending, "a chunk lacks indexes"
                chunk = self._close(chunk, start)
            self.found[opcode] += 1
            if opcode == HEADER:
                self.contents.profile, self.contents.library = cursor.text(), cursor.text()
            elif opcode == CHUNK:
                chunk, pending = self._chunk(cursor, start, stop)
            elif opcode == MESSAGE_INDEX:
                (channel,) = cursor.numbers("H")
                inner, entries = Cursor(cursor.bytes(cursor.numbers("I")[0])), []
                while inner.at < len(inner.data):
                    entries.append(inner.numbers("QQ"))
                assert sorted(entries) == sorted(pending.pop(channel)), "an index points elsewhere"
                chunk["offsets"][channel] = start
            elif opcode == DATA_END:
                assert cursor.numbers("I")[0] in {0, zlib.crc32(self.data[:start])}
                assert stop == end, "something stands behind the end of data"
            else:
                self._record(opcode, cursor, start, stop)
            if opcode != DATA_END:
                cursor.end()
        assert self.found[DATA_END] == 1

    def _record(self, opcode, cursor, start, stop):
        """What may stand in and outside of chunks."""
        contents = self.contents
        if opcode == SCHEMA:
            (number,) = cursor.numbers("H")
            schema = (cursor.text(), cursor.text(), cursor.bytes(cursor.numbers("I")[0]))
            assert number != 0
            assert contents.schemas.setdefault(number, schema) == schema
        elif opcode == CHANNEL:
            number, schema = cursor.numbers("HH")
            channel = (schema, cursor.text(), cursor.text(), cursor.texts())
            assert schema == 0 or schema in contents.schemas
            assert contents.channels.setdefault(number, channel) == channel
        elif opcode == MESSAGE:
            channel, sequence, logged, published = cursor.numbers("HIQQ")
            data = cursor.bytes(len(cursor.data) - cursor.at)
            contents.messages.append((contents.channels[channel][1], sequence, logged, published, data))
            self.counts[channel] += 1
            self.times.append(logged)
        elif opcode == ATTACHMENT:
            logged, created = cursor.numbers("QQ")
            name, media = cursor.text(), cursor.text()
            data = cursor.bytes(cursor.numbers("Q")[0])
            assert zlib.crc32(cursor.data[: cursor.at]) == cursor.numbers("I")[0]
            contents.attachments.append((name, media, data))
            self.indexes[ATTACHMENT_INDEX, start] = (stop - start, logged, created, len(data), name, media)
        elif opcode == METADATA:
            name = cursor.text()
            contents.metadata.append((name, cursor.texts()))
            self.indexes[METADATA_INDEX, start] = (stop - start, name)
        else:
            raise AssertionError(f"opcode {opcode} has no place here")

    def _chunk(self, cursor, start, stop):
        first, last, size, crc = cursor.numbers("QQQI")
        compression = cursor.text()
        packed = cursor.bytes(cursor.numbers("Q")[0])
        inside = unpacked(compression, packed)
        assert len(inside) == size
        assert crc in {0, zlib.crc32(inside)}
        where, times = {}, []
        for opcode, content, at, _ in records(inside, 0, len(inside)):
            assert opcode in {SCHEMA, CHANNEL, MESSAGE}
            inner = Cursor(content)
            self._record(opcode, inner, 0, 0)
            inner.end()
            if opcode == MESSAGE:
                channel, _, logged, _ = struct.unpack_from("<HIQQ", content)
                where.setdefault(channel, []).append((logged, at))
                times.append(logged)
        assert (first, last) == ((min(times), max(times)) if times else (0, 0))
        self.contents.chunks += 1
        about = {"start": start, "stop": stop, "offsets": {}, "sizes": (compression, len(packed), size)}
        return {**about, "times": (first, last)}, where

    def _close(self, chunk, end):
        """The chunk's indexes end here."""
        if chunk is not None:
            span = (*chunk["times"], chunk["start"], chunk["stop"] - chunk["start"])
            content = (*span, chunk["offsets"], end - chunk["stop"], *chunk["sizes"])
            self.indexes[CHUNK_INDEX, chunk["start"]] = content

    def _summary(self, start, end):
        schemas, channels = {}, {}
        statistics = 0
        for opcode, content, _, _ in records(self.data, start, end):
            cursor = Cursor(content)
            if opcode == SCHEMA:
                number = cursor.numbers("H")[0]
                schemas[number] = (cursor.text(), cursor.text(), cursor.bytes(cursor.numbers("I")[0]))
            elif opcode == CHANNEL:
                number, schema = cursor.numbers("HH")
                channels[number] = (schema, cursor.text(), cursor.text(), cursor.texts())
            elif opcode == STATISTICS:
                statistics += 1
                self._statistics(cursor)
            else:
                self._index(opcode, cursor)
            cursor.end()
        assert statistics == 1
        assert schemas == self.contents.schemas
        assert channels == self.contents.channels
        assert not self.indexes, f"the summary does not name {self.indexes.keys()}"

    def _index(self, opcode, cursor):
        if opcode == CHUNK_INDEX:
            first, last, start, length = cursor.numbers("QQQQ")
            offsets = cursor.pairs(lambda c: c.numbers("H")[0], lambda c: c.numbers("Q")[0])
            (indexes,) = cursor.numbers("Q")
            said = (first, last, start, length, offsets, indexes, cursor.text(), *cursor.numbers("QQ"))
        elif opcode == ATTACHMENT_INDEX:
            start, *numbers = cursor.numbers("QQQQQ")
            said = (*numbers, cursor.text(), cursor.text())
        else:
            assert opcode == METADATA_INDEX
            start, length = cursor.numbers("QQ")
            said = (length, cursor.text())
        assert said == self.indexes.pop((opcode, start)), f"index {opcode} of {start} is wrong"

    def _statistics(self, cursor):
        messages, schemas, channels, attachments, metadata, chunks, first, last = cursor.numbers("QHIIIIQQ")
        counts = cursor.pairs(lambda c: c.numbers("H")[0], lambda c: c.numbers("Q")[0])
        found = self.contents
        assert messages == len(found.messages)
        assert (schemas, channels) == (len(found.schemas), len(found.channels))
        assert (attachments, metadata, chunks) == (len(found.attachments), len(found.metadata), found.chunks)
        assert (first, last) == ((min(self.times), max(self.times)) if self.times else (0, 0))
        assert {channel: count for channel, count in counts.items() if count} == self.counts

    def _offsets(self, summary_start, start, end):
        """Groups of the summary, which must lie side by side and cover it."""
        groups = []
        for opcode, content, _, _ in records(self.data, start, end):
            assert opcode == SUMMARY_OFFSET
            group, at, length = Cursor(content).numbers("BQQ")
            assert {opcode for opcode, *_ in records(self.data, at, at + length)} <= {group}
            groups.append((at, at + length))
        edges = [summary_start, *(stop for _, stop in sorted(groups))]
        assert [at for at, _ in sorted(groups)] == edges[:-1]
        assert edges[-1] == start


def read(path):
    """Contents of a finished file; an AssertionError says what is wrong with it."""
    return Reader(path.read_bytes()).read()
