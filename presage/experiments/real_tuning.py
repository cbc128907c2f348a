"""The particle filter at its best: its settings are tuned on stretches of the first half, one after another.

Odometry's noise is learned from the first half as it is for preset precise. Every other value is tried on the same
stretches, with and without odometry; what tracks the most scans and then has the least median error is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from presage.experiments.real_drive import LASER, ODOMETRY, Job, trial
from services.estimator.precise.motion import MotionNoise

TRIED: dict[str, tuple[float, ...]] = {
    "sigma_hit": (0.05, 0.1, 0.2),
    "sigma_odometry": (0.03, 0.05, 0.1),
    "z_rand": (0.05, 0.2, 0.5),
    "max_beams": (60, 180),
    "jitter_position": (0.02, 0.05, 0.1),
    "jitter_heading": (0.02, 0.05, 0.1),
}
STRETCHES, LENGTH = 3, 40  # of the first half: so many, of so many scans
ON_THE_WAY = 0.5  # m, within which a scan counts as tracked
Settings = tuple[tuple[str, float], ...]


def starting_point(motion: MotionNoise) -> Settings:
    """What the first half says of odometry: standard deviations of AMCL's omnidirectional model, per metre and radian."""
    along = float(np.sqrt(motion.path_by_path / 0.1))  # over steps of a decimetre, AMCL's grow with the path itself
    return (
        ("alpha1", motion.path_by_turn), ("alpha2", motion.turn_by_path / 0.1), ("alpha3", along**2),
        ("alpha4", motion.turn_by_turn / 0.1), ("alpha5", along**2),
    )  # fmt: skip


def tune(job: Job, half: int, start: Settings, report: Callable[[str, float], None]) -> tuple[Settings, list[str]]:
    """The best settings found and what was tried, for people; ``job``: log, map and mount; ``half``: its scans."""
    length = min(LENGTH, half // STRETCHES)
    firsts = [int(x) for x in np.linspace(0, half - length, STRETCHES)]
    best, lines, done = dict(start), [], 0
    total = sum(map(len, TRIED.values()))
    score = _score(job, firsts, length, best)
    for name, values in TRIED.items():
        for value in values:
            changed = {**best, name: value, **({"z_hit": 1 - value} if name == "z_rand" else {})}
            found = _score(job, firsts, length, changed)
            lines.append(f"{name} {value:g}: {found[0]:.0%} tracked, {-found[1] * 1e3:.0f} mm")
            if found > score:
                best, score = changed, found
            done += 1
            report(f"particle filter: {name}", done / total)
    return tuple(best.items()), lines


def _score(job: Job, firsts: list[int], length: int, settings: dict[str, float]) -> tuple[float, float]:
    """Share of scans tracked, and minus the median error (m) of those."""
    errors = []
    for task in (ODOMETRY, LASER):
        for first in firsts:
            row = trial(replace(job, task=task, first=first, count=length, particles=tuple(settings.items())))
            errors += row["error_m"]
    off = np.array(errors)
    tracked = off < ON_THE_WAY
    return round(float(tracked.mean()), 2), -float(np.median(off[tracked])) if tracked.any() else -np.inf
