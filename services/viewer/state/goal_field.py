"""The goal preference for the page."""

from __future__ import annotations

from collections import OrderedDict
from contextlib import suppress

import numpy as np

from common.messages.definitions import Preference
from services.viewer.state.frames import encode_frame, pose_as_json

MAX_CELLS = 40_000  # 160 kB per message
MAX_STORED_FIELDS = 32  # of a replay, which may seek back to earlier fields


class GoalFields:
    """Goal fields of one robot, encoded for the page."""

    def __init__(self) -> None:
        self.shown: bytes | None = None  # the field last sent to visitors
        self._by_stamp: OrderedDict[int, bytes] = OrderedDict()

    def add(self, message: Preference, robot: str, *, live: bool) -> None:
        """Stores a field. Of a live robot only the last one is kept, which also holds after a simulation restarts."""
        with suppress(ValueError):  # non-finite numbers in the header cannot be encoded
            data = field_of(message, robot)
            self._store(message.stamp_ns, data, only_last=live)

    def _store(self, stamp_ns: int, data: bytes, *, only_last: bool) -> None:
        if only_last:
            self._by_stamp.clear()
        self._by_stamp[stamp_ns] = data
        self._by_stamp.move_to_end(stamp_ns)
        if len(self._by_stamp) > MAX_STORED_FIELDS:
            self._by_stamp.popitem(last=False)

    def change(self, stamp_ns: int, *, live: bool) -> bytes | None:
        """The field valid at a stamp. Returns None if there is none, or if it is the one last sent."""
        known = [stamp for stamp in self._by_stamp if live or stamp <= stamp_ns]
        current = self._by_stamp[max(known)] if known else None
        if current is None or current is self.shown:
            return None
        self.shown = current
        return current


def field_of(message: Preference, robot: str) -> bytes:
    """A goal field as a binary message of type ``field``. Large fields are subsampled to at most `MAX_CELLS` cells."""
    values = message.distance.reshape(message.height, message.width)
    step = max(1, int(np.ceil(np.sqrt(values.size / MAX_CELLS))))
    first = min(step // 2, *(size - 1 for size in values.shape))
    values = values[first::step, first::step]
    shift = (first + 0.5 - step / 2) * message.resolution  # of the origin, so that the centres of kept cells stay
    header = {
        "type": "field",
        "robot": robot,
        "t": message.stamp_ns * 1e-9,
        "goal": pose_as_json(message.goal),
        "origin": {"x": message.origin.x + shift, "y": message.origin.y + shift},
        "resolution": message.resolution * step,
        "width": values.shape[1],
        "height": values.shape[0],
    }
    return encode_frame(header, {"distance": values.ravel()})
