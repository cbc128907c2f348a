"""The goal preference for the page."""

from __future__ import annotations

from collections import OrderedDict
from contextlib import suppress

import numpy as np

from common.messages.definitions import Preference
from services.viewer.state.frames import encode, pose_of

MAX_CELLS = 40_000  # of the picture at most, 160 kB
MAX_STORED_FIELDS = 32  # fields of a replay, which may go back to each


class GoalFields:
    """Those of one robot."""

    def __init__(self) -> None:
        """None heard."""
        self.shown: bytes | None = None  # what visitors have been told last
        self._by_stamp: OrderedDict[int, bytes] = OrderedDict()

    def add(self, message: Preference, robot: str, *, live: bool) -> None:
        """Keep one; of a live robot, not of a replay, the last alone, though its simulation began anew."""
        with suppress(ValueError):  # cells larger than all numbers: nobody can draw them
            picture = field_of(message, robot)
            self._keep(message.stamp_ns, picture, alone=live)

    def _keep(self, stamp_ns: int, picture: bytes, *, alone: bool) -> None:
        if alone:
            self._by_stamp.clear()
        self._by_stamp[stamp_ns] = picture
        self._by_stamp.move_to_end(stamp_ns)
        if len(self._by_stamp) > MAX_STORED_FIELDS:
            self._by_stamp.popitem(last=False)

    def change(self, stamp_ns: int, *, live: bool) -> bytes | None:
        """The field that holds at a time, if visitors were told another; None: nothing is to be told."""
        known = [stamp for stamp in self._by_stamp if live or stamp <= stamp_ns]
        now = self._by_stamp[max(known)] if known else None
        if now is None or now is self.shown:
            return None
        self.shown = now
        return now


def field_of(message: Preference, robot: str) -> bytes:
    """A binary message of type ``field``; a large one is thinned out, each cell's value is that of its middle."""
    values = message.distance.reshape(message.height, message.width)
    step = max(1, int(np.ceil(np.sqrt(values.size / MAX_CELLS))))
    first = min(step // 2, *(size - 1 for size in values.shape))
    values = values[first::step, first::step]
    shift = (first + 0.5 - step / 2) * message.resolution  # of the corner, so that kept cells keep their middles
    header = {
        "type": "field",
        "robot": robot,
        "t": message.stamp_ns * 1e-9,
        "goal": pose_of(message.goal),
        "origin": {"x": message.origin.x + shift, "y": message.origin.y + shift},
        "resolution": message.resolution * step,
        "width": values.shape[1],
        "height": values.shape[0],
    }
    return encode(header, {"distance": values.ravel()})
