"""The particle filter at its best: its settings are tuned on stretches of the first half, one after another.

Odometry's noise is learned from the first half as it is for preset precise. Every other value is tried on the same
stretches: for tracking, with and without odometry, what keeps the most scans and then has the least median error; for
finding, from there on, what finds the most starts and then in the fewest scans. Two sets, so that neither task suffers
from what the other needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from presage.experiments.real_drive import GLOBAL, LASER, NEAR_ENOUGH, ODOMETRY, Job, trial
from services.estimator.precise.motion import MotionNoise

TRIED: dict[str, tuple[float, ...]] = {
    "sigma_search": (0.1, 0.2),
    "jitter_position": (0.005, 0.015),
    "jitter_heading": (0.005, 0.015),
    "sigma_hit": (0.05, 0.1),
    "sigma_odometry": (0.03, 0.05),
    "z_rand": (0.2, 0.5),
    "alpha": (4.0, 16.0),
}  # alpha: all five, times what the odometry says
TRIED_TO_FIND: dict[str, tuple[float, ...]] = {
    "sigma_search": (0.2, 0.5),
    "jitter_position": (0.005, 0.05),
}
STRETCHES, LENGTH = 2, 30  # of the first half: so many, of so many scans
STARTS, TO_FIND = 4, 15  # places to find, and scans it may take
Settings = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Tuned:
    """Settings of the particle filter."""

    tracking: Settings
    finding: Settings
    tried: list[str]  # share of scans kept, or of starts found; then median error (m), or mean scans


def starting_point(motion: MotionNoise) -> Settings:
    """Of odometry, by the first half: variances of AMCL's omnidirectional model, per square metre and radian."""
    along = float(np.sqrt(motion.path_by_path / 0.1))  # over steps of a decimetre, AMCL's grow with the path itself
    return (
        ("alpha1", motion.path_by_turn), ("alpha2", motion.turn_by_path / 0.1), ("alpha3", along**2),
        ("alpha4", motion.turn_by_turn / 0.1), ("alpha5", along**2),
    )  # fmt: skip


def tune(job: Job, half: int, start: Settings, report: Callable[[str, float], None]) -> Tuned:
    """The best settings found; ``job``: log, map and mount; ``half``: scans of the first half."""
    lines: list[str] = []
    total = sum(map(len, TRIED.values())) + sum(map(len, TRIED_TO_FIND.values())) + 2
    length = min(LENGTH, half // STRETCHES)
    firsts = [int(x) for x in np.linspace(0, half - length, STRETCHES)]

    def tracking(settings: Settings) -> tuple[float, float]:
        rows = [
            trial(replace(job, task=task, first=first, count=length, particles=settings))
            for task in (ODOMETRY, LASER)
            for first in firsts
        ]
        return _kept(rows)

    def finding(settings: Settings) -> tuple[float, float]:
        starts = np.linspace(0, half - LENGTH, STARTS)
        rows = [trial(replace(job, task=GLOBAL, first=int(k), count=TO_FIND, particles=settings)) for k in starts]
        return _found(rows)

    def climb(
        settings: Settings, tried: dict[str, tuple[float, ...]], score: Callable[[Settings], tuple[float, float]]
    ) -> Settings:
        best, most = settings, score(settings)
        lines.append(f"{score.__name__}, as it begins: {most[0]:.0%}, {-most[1]:.3g}")
        for name, values in tried.items():
            base = best
            for value in values:
                changed = _with(base, name, value)
                found = score(changed)
                lines.append(f"{score.__name__}, {name} {value:g}: {found[0]:.0%}, {-found[1]:.3g}")
                if found > most:
                    best, most = changed, found
                report(f"particle filter, {score.__name__}: {name}", len(lines) / total)
        return best

    track = climb(start, TRIED, tracking)
    return Tuned(track, climb(track, TRIED_TO_FIND, finding), lines)


def _with(settings: Settings, name: str, value: float) -> Settings:
    values = dict(settings)
    if name == "alpha":
        return tuple({**values, **{f"alpha{k}": values[f"alpha{k}"] * value for k in range(1, 6)}}.items())
    return tuple({**values, name: value, **({"z_hit": 1 - value} if name == "z_rand" else {})}.items())


def _kept(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Share of scans tracked, and minus the median error (m) of those."""
    off = np.array([value for row in rows for value in row["error_m"]])
    tracked = off < NEAR_ENOUGH
    return round(float(tracked.mean()), 2), -float(np.median(off[tracked])) if tracked.any() else -np.inf


def _found(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Share of starts found, and minus the mean of the scans until then."""
    scans = []
    for row in rows:
        right = (np.array(row["error_m"]) < NEAR_ENOUGH) & (np.array(row["state"]) == "tracking")
        scans.append(int(np.argmax(right)) + 1 if right.any() else None)
    found = [k for k in scans if k is not None]
    return len(found) / len(rows), -float(np.mean([TO_FIND if k is None else k for k in scans]))
