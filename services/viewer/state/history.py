"""The last minute of the charts."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

SPAN_S = 60.0  # s of stamps
MAX_SAMPLES = 5000  # samples, whatever the rate


@dataclass(frozen=True)
class ChartSample:
    """One belief's worth."""

    t: float  # s, its stamp
    free_energy: float  # nats
    accuracy: float  # nats
    complexity: float  # nats
    error: float | None  # m, from the truth
    speed: float | None  # m/s


class History:
    """Samples in order of their stamps."""

    def __init__(self) -> None:
        """Empty."""
        self._samples: deque[ChartSample] = deque(maxlen=MAX_SAMPLES)

    def add(self, sample: ChartSample) -> None:
        """The newest; those of its stamp or later are gone then, and those more than `SPAN_S` older."""
        samples = self._samples
        while samples and samples[-1].t >= sample.t:
            samples.pop()
        while samples and samples[0].t < sample.t - SPAN_S:
            samples.popleft()
        samples.append(sample)

    def clear(self) -> None:
        """Forget all."""
        self._samples.clear()

    def columns(self) -> dict[str, list[Any]]:
        """One list a quantity, all of one length."""
        names = ("t", "free_energy", "accuracy", "complexity", "error", "speed")
        return {name: [getattr(sample, name) for sample in self._samples] for name in names}
