"""The last minute of the charts."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

SPAN_S = 60.0  # by the stamps
MAX_SAMPLES = 5000


@dataclass(frozen=True)
class ChartSample:
    """Values of one belief."""

    t: float  # stamp, s
    free_energy: float | None  # nats; None, like the two below, if the estimator does not compute it
    accuracy: float | None  # nats
    complexity: float | None  # nats
    error: float | None  # m, distance from the true position
    speed: float | None  # m/s


class History:
    """Samples in order of their stamps."""

    def __init__(self) -> None:
        self._samples: deque[ChartSample] = deque(maxlen=MAX_SAMPLES)

    def add(self, sample: ChartSample) -> None:
        """Adds the newest sample. Removes samples with its stamp or later, and those more than `SPAN_S` older."""
        samples = self._samples
        while samples and samples[-1].t >= sample.t:
            samples.pop()
        while samples and samples[0].t < sample.t - SPAN_S:
            samples.popleft()
        samples.append(sample)

    def clear(self) -> None:
        """Removes all samples."""
        self._samples.clear()

    def columns(self) -> dict[str, list[Any]]:
        """One list per quantity, all of the same length."""
        names = ("t", "free_energy", "accuracy", "complexity", "error", "speed")
        return {name: [getattr(sample, name) for sample in self._samples] for name in names}
