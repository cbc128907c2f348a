"""Messages of the field that was learned while driving: split into parts, and joined again."""

from __future__ import annotations

import numpy as np

from common.messages.definitions import LearnedField

PART_BYTES = 1 << 19  # of data in one message; the bus accepts payloads of twice this size


def split_into_messages(data: bytes, version: int, base: str, stamp_ns: int) -> list[LearnedField]:
    """Splits an encoded field into messages."""
    pieces = [data[begin : begin + PART_BYTES] for begin in range(0, len(data), PART_BYTES)]
    return [
        LearnedField(
            stamp_ns=stamp_ns,
            version=version,
            base=base,
            part=part,
            parts=len(pieces),
            data=np.frombuffer(piece, np.uint8),
        )
        for part, piece in enumerate(pieces)
    ]


class FieldAssembler:
    """Joins the parts of one version after another."""

    def __init__(self) -> None:
        self._parts: list[LearnedField] = []

    def add(self, message: LearnedField) -> bytes | None:
        """Returns the encoded field if the message is its last part, and none is missing."""
        if message.part == 0:
            self._parts = []
        self._parts.append(message)
        same = {(each.version, each.base, each.parts, each.stamp_ns) for each in self._parts}
        complete = [each.part for each in self._parts] == list(range(message.parts))
        return b"".join(each.data.tobytes() for each in self._parts) if complete and len(same) == 1 else None
