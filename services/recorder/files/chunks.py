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
# A file of 200 kB can state and hold chunks of gigabytes; the recorder writes at most half of this.
MAX_CHUNK_BYTES = 1 << 24
MAGIC = b"\x89MCAP0\r\n"  # what every file begins and ends with
PREFIX = Struct("<BQ")  # of every record: opcode, length of what follows (MCAP specification, "Records")
BUILDER = "_Writer__chunk_builder"  # mcap has no setting that repeats declarations
MESSAGE = Struct("<HIQQ")  # channel, sequence, log time, publish time


class SelfContainedChunk(ChunkBuilder):
    """A chunk with the schemas and channels of all its messages: where another chunk is damaged, it stays readable."""

    def __init__(self) -> None:
        super().__init__()
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._here: set[tuple[type, int]] = set()  # schemas and channels that are in this chunk

    def add_schema(self, schema: Schema) -> None:
        """Put it into this chunk, and later into each that needs it."""
        self._schemas[schema.id] = schema
        self._declare_schema(schema)

    def add_channel(self, channel: Channel) -> None:
        """Put it into this chunk, and later into each that has messages of it."""
        self._channels[channel.id] = channel
        self._declare_channel(channel)

    def add_message(self, message: Message) -> None:
        """Add a message behind the declaration of its channel."""
        self._declare_channel(self._channels[message.channel_id])
        super().add_message(message)

    def reset(self) -> None:
        """Begin the next chunk."""
        super().reset()  # type: ignore[no-untyped-call]
        self._here.clear()

    def _declare_schema(self, schema: Schema) -> None:
        if (Schema, schema.id) not in self._here:
            self._here.add((Schema, schema.id))
            super().add_schema(schema)

    def _declare_channel(self, channel: Channel) -> None:
        if (Channel, channel.id) in self._here:
            return
        self._here.add((Channel, channel.id))
        if channel.schema_id:
            self._declare_schema(self._schemas[channel.schema_id])
        super().add_channel(channel)


def mcap_writer(stream: BinaryIO, compression: str, chunk_size: int) -> tuple[Writer, SelfContainedChunk]:
    """A writer with checksums of every part of the file, and the chunk it fills."""
    writer = Writer(stream, chunk_size=chunk_size, compression=COMPRESSION[compression], enable_data_crcs=True)
    if not isinstance(getattr(writer, BUILDER, None), ChunkBuilder):
        raise TypeError("this version of the package mcap builds its chunks elsewhere: install mcap 1.6")
    chunk = SelfContainedChunk()
    setattr(writer, BUILDER, chunk)
    return writer, chunk


def records_of(chunk: Chunk) -> Iterator[Schema | Channel | Message]:
    """What is in a chunk; raises ValueError or the decompressor's own error where it is damaged or too large.

    The checksum is compared before the first record comes.
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
    """The records of a chunk as bytes; raises as `records_of`, and never makes more than `MAX_CHUNK_BYTES`."""
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, where at most {MAX_CHUNK_BYTES} are read")
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in {-1, size}:  # -1: the frame does not state it
            raise ValueError("a chunk's size is not what it states")
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"a chunk is compressed with {chunk.compression[:20]!r}, which is not known here")
    if len(data) != size:
        raise ValueError("a chunk's size is not what it states")
    return bytes(data)
