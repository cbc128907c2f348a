"""Driving by hand, with a timeout."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.messages.definitions import Drive

HOLDS = 500_000_000  # ns a drive message counts, and a hand that asks to stand keeps the goal waiting


class Hand:
    """The last velocity asked for by hand."""

    def __init__(self) -> None:
        """Nobody drives."""
        self._twist = np.zeros(3)
        self._heard: int | None = None  # ns, when the last message came
        self._standing: int | None = None  # ns, since when it asks to stand

    def hear(self, drive: Drive, now_ns: int) -> None:
        """Somebody drives; ``now_ns`` is the stamp of what was measured last."""
        self._twist = drive.twist.array()
        if self._twist.any():
            self._standing = None
        elif self._standing is None or self._silent(now_ns):
            self._standing = now_ns
        self._heard = now_ns

    def twist(self, now_ns: int) -> Array | None:
        """(3,) m/s, m/s, rad/s in base_link, as asked for; None where nobody drives, or no more."""
        if self._silent(now_ns) or (self._standing is not None and now_ns - self._standing > HOLDS):
            return None
        return self._twist

    def _silent(self, now_ns: int) -> bool:
        if self._heard is not None and now_ns < self._heard:  # the simulation began anew: that was another run
            self._heard = None
        return self._heard is None or now_ns - self._heard > HOLDS
