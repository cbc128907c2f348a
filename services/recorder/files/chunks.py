"""Chunks of an MCAP file: written self-contained, read with a size limit."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from io import BytesIO
from struct import Struct
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap._chunk_builder import ChunkBuilder
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.writer import CompressionType, Writer

COMPRESSION = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
# A file of 200 kB can unpack to chunks of gigabytes. The recorder writes at most half of this.
MAX_CHUNK_BYTES = 1 << 24
MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of every file
PREFIX = Struct("<BQ")  # first bytes of every record: opcode and length (MCAP specification, "Records")
BUILDER = "_Writer__chunk_builder"  # private: mcap has no option to repeat declarations in each chunk
MESSAGE = Struct("<HIQQ")  # channel, sequence, log time, publish time


class SelfContainedChunk(ChunkBuilder):
    """A chunk that repeats the schemas and channels of its messages, so it stays readable if others are damaged."""

    def __init__(self) -> None:
        super().__init__()
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._declared: set[tuple[type, int]] = set()  # schemas and channels that are in this chunk

    def add_schema(self, schema: Schema) -> None:
        """Adds the schema to this chunk, and to each later chunk that needs it."""
        self._schemas[schema.id] = schema
        self._declare_schema(schema)

    def add_channel(self, channel: Channel) -> None:
        """Adds the channel to this chunk, and to each later chunk that has messages of it."""
        self._channels[channel.id] = channel
        self._declare_channel(channel)

    def add_message(self, message: Message) -> None:
        """Adds a message, after the declaration of its channel."""
        self._declare_channel(self._channels[message.channel_id])
        super().add_message(message)

    def reset(self) -> None:
        """Begins the next chunk."""
        super().reset()  # type: ignore[no-untyped-call]
        self._declared.clear()

    def _declare_schema(self, schema: Schema) -> None:
        if (Schema, schema.id) not in self._declared:
            self._declared.add((Schema, schema.id))
            super().add_schema(schema)

    def _declare_channel(self, channel: Channel) -> None:
        if (Channel, channel.id) in self._declared:
            return
        self._declared.add((Channel, channel.id))
        if channel.schema_id:
            self._declare_schema(self._schemas[channel.schema_id])
        super().add_channel(channel)


def mcap_writer(stream: BinaryIO, compression: str, chunk_size: int) -> tuple[Writer, SelfContainedChunk]:
    """Returns a writer that checksums every part of the file, and the chunk that it fills."""
    writer = Writer(stream, chunk_size=chunk_size, compression=COMPRESSION[compression], enable_data_crcs=True)
    if not isinstance(getattr(writer, BUILDER, None), ChunkBuilder):
        raise TypeError("this version of the package mcap is not supported: install mcap 1.6")
    chunk = SelfContainedChunk()
    setattr(writer, BUILDER, chunk)
    return writer, chunk


def records_of(chunk: Chunk) -> Iterator[Schema | Channel | Message]:
    """Yields the records of a chunk, after checking its checksum.

    Raises ValueError, or the decompressor's own error, if the chunk is damaged or too large.
    """
    data = uncompressed(chunk)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("a chunk's checksum is wrong")
    at = 0
    while at < len(data):
        opcode, length = PREFIX.unpack_from(data, at)
        begin, at = at + PREFIX.size, at + PREFIX.size + length
        if at > len(data):
            raise ValueError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = MESSAGE.unpack_from(data, begin)
            yield Message(
                channel_id=channel,
                log_time=log_time,
                data=data[begin + MESSAGE.size : at],
                publish_time=publish_time,
                sequence=sequence,
            )
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            body = ReadDataStream(BytesIO(data[begin:at]))
            yield Schema.read(body) if opcode == Opcode.SCHEMA else Channel.read(body)


def uncompressed(chunk: Chunk) -> bytes:
    """The uncompressed records of a chunk, at most `MAX_CHUNK_BYTES`. Raises the errors of `records_of`."""
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, where at most {MAX_CHUNK_BYTES} are read")
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in {-1, size}:  # -1: the frame does not state its size
            raise ValueError("a chunk's size is not what it states")
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"a chunk has the unknown compression {chunk.compression[:20]!r}")
    if len(data) != size:
        raise ValueError("a chunk's size is not what it states")
    return bytes(data)
