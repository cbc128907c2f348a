"""Chunks of an MCAP file: written self-contained, read with a size limit."""

from __future__ import annotations

from dataclasses import replace
from struct import Struct
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap._chunk_builder import ChunkBuilder
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

COMPRESSION = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
CHUNK_BYTES = 1 << 18  # the recorder ends a chunk when it is this large; a crash loses at most one chunk
MAX_CHUNK_BYTES = 1 << 24  # read at most; far more than CHUNK_BYTES, which one message and declarations may exceed
MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of every file
PREFIX = Struct("<BQ")  # first bytes of every record: opcode and length (MCAP specification, "Records")
# Private in mcap 1.6, whose writer declares each channel in one chunk only and has no option to repeat declarations.
CHUNK_BUILDER = "_Writer__chunk_builder"


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
    if not isinstance(getattr(writer, CHUNK_BUILDER, None), ChunkBuilder):
        raise TypeError("this version of the package mcap is not supported: install mcap 1.6")
    chunk = SelfContainedChunk()
    setattr(writer, CHUNK_BUILDER, chunk)
    return writer, chunk


def unpacked_records(chunk: Chunk) -> list[McapRecord]:
    """The schemas, channels and messages of a chunk, after checking its checksum.

    Raises ValueError, or the decompressor's own error, if the chunk is damaged or too large.
    """
    return breakup_chunk(replace(chunk, compression="", data=uncompressed(chunk)), validate_crc=True)


def uncompressed(chunk: Chunk) -> bytes:
    """The uncompressed records of a chunk, at most `MAX_CHUNK_BYTES`. Raises the errors of `unpacked_records`.

    mcap's own decompression has no limit, and a file of 200 kB can unpack to chunks of gigabytes.
    """
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
