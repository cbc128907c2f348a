"""The summary of an MCAP file, and its messages in order of time.

mcap's SeekingReader does the same, but checks no checksum of the summary and limits neither the size of unpacked chunks
nor the memory of messages that wait for their turn.
"""

from __future__ import annotations

import heapq
import os
import zlib
from collections.abc import Collection, Iterator
from struct import Struct
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Message
from mcap.summary import Summary

from services.recorder.files.chunks import MAGIC, PREFIX, unpacked_records

FOOTER = Struct("<BQQQI")  # opcode, length, offset of the summary, offset of the summary offsets, summary checksum
CRC_BYTES = 4  # size of the checksum, which itself is not part of the checksummed data
MESSAGE_OVERHEAD_BYTES = 512  # approximate memory of a message besides its payload
MAX_WAITING_BYTES = 1 << 28  # messages held in memory to sort them by time, if chunks overlap


def summary_of(stream: BinaryIO) -> Summary | None:
    """The summary at the end of a file. Returns None if the file has none; raises ValueError if it is damaged."""
    size = stream.seek(0, os.SEEK_END)
    footer = size - len(MAGIC) - FOOTER.size
    stream.seek(max(0, footer))
    tail = stream.read()
    if footer < len(MAGIC) or not tail.endswith(MAGIC):
        raise ValueError("its end is missing")
    opcode, length, start, _, crc = FOOTER.unpack_from(tail)
    if (opcode, length) != (Opcode.FOOTER, FOOTER.size - PREFIX.size):
        raise ValueError("its end is damaged")
    if start == 0:
        return None
    stream.seek(start)
    summary = stream.read(max(0, footer + FOOTER.size - CRC_BYTES - start))
    if crc and zlib.crc32(summary) != crc:
        raise ValueError("its index is damaged")
    stream.seek(0)
    return SeekingReader(stream, record_size_limit=size).get_summary()


def messages_in_order(
    stream: BinaryIO, summary: Summary, keys: Collection[str] | None, start_ns: int | None, end_ns: int | None
) -> Iterator[tuple[Channel, Message]]:
    """Yields the selected messages in the order of their log times. Raises if a chunk is damaged."""
    ids = {number for number, channel in summary.channels.items() if keys is None or channel.topic in keys}
    # Holds chunk indexes and messages, ordered by time and then by position in the file; a chunk (number -1) comes
    # before its own messages.
    queue: list[tuple[int, int, int, Any]] = [
        (index.message_start_time, index.chunk_start_offset, -1, index)
        for index in summary.chunk_indexes
        if not index.message_index_offsets or not ids.isdisjoint(index.message_index_offsets)
    ]
    heapq.heapify(queue)
    waiting = 0  # bytes
    while queue:
        _, offset, _, entry = heapq.heappop(queue)
        if not isinstance(entry, ChunkIndex):
            waiting -= len(entry.data) + MESSAGE_OVERHEAD_BYTES
            yield summary.channels[entry.channel_id], entry
            continue
        if (start_ns is not None and entry.message_end_time < start_ns) or (
            end_ns is not None and entry.message_start_time >= end_ns
        ):
            continue
        stream.seek(offset + PREFIX.size)
        for number, record in enumerate(unpacked_records(Chunk.read(ReadDataStream(stream)))):
            if not isinstance(record, Message) or record.channel_id not in ids:
                continue
            log_time = record.log_time
            if (start_ns is None or log_time >= start_ns) and (end_ns is None or log_time < end_ns):
                heapq.heappush(queue, (log_time, offset, number, record))
                waiting += len(record.data) + MESSAGE_OVERHEAD_BYTES
        if waiting > MAX_WAITING_BYTES:
            raise ValueError("too many chunks overlap in time")
