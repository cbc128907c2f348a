"""Splits a distance field that was learned while driving into messages, and joins the messages again."""

from __future__ import annotations

import numpy as np

from common.messages.definitions import LearnedField

PART_BYTES = 1 << 19  # of data in one message; the bus accepts payloads of twice this size


def split_into_messages(data: bytes, version: int, base: str, stamp_ns: int) -> list[LearnedField]:
    """Splits an encoded distance field into messages of at most `PART_BYTES`.

    ``base`` is the SHA-256 of the weights from which learning began, ``version`` the number of the learned version.
    """
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
    """Joins the parts of a version; the parts of the next version replace them."""

    def __init__(self) -> None:
        self._parts: list[LearnedField] = []

    def add(self, message: LearnedField) -> bytes | None:
        """Adds a part. Returns the encoded field after its last part, if all parts came in order."""
        if message.part == 0:
            self._parts = []
        self._parts.append(message)
        same = {(each.version, each.base, each.parts, each.stamp_ns) for each in self._parts}
        complete = [each.part for each in self._parts] == list(range(message.parts))
        return b"".join(each.data.tobytes() for each in self._parts) if complete and len(same) == 1 else None
