"""Creates, moves, merges, weighs and drops hypotheses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from common.geometry import se2
from services.estimator.precise.gauss_newton import MAX_STEP, Prior, difference, limited, of_position
from services.estimator.precise.motion_model import smoothed

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.precise.likelihood import Evidence
    from services.estimator.precise.motion_model import Fused
    from services.estimator.precise.settings import Settings

SAME_PLACE, SAME_YAW = 0.1, 0.1  # m, rad: nearer modes are one
MEMORY = 0.8  # of the evidence of earlier scans; a model's error repeats, so evidence must not add up for ever
BLIND, RIPPLES = 1e-4, 7.0  # information along, as a share of that across, that counts as none; of the ripple's
GOOD_SCANS = 10  # in which a rival must have looked as scans of their place do
NEGLIGIBLE = 1e-4  # weight below which a hypothesis is refuted


@dataclass(frozen=True)
class Mode:
    """One hypothesis and what the last scan says about it."""

    pose: Array  # (3,) base_link in map
    noise: Array  # (3, 3) covariance that scanner noise and motion leave: fusion makes it smaller
    error: Array  # (3, 3) covariance that the model's error leaves, for independent beams: fusion does not
    explained: float  # share of beams
    accuracy: float  # nats, of the last scan
    complexity: float  # nats
    energy: float  # nats, F averaged over the last scans: what weights come from
    xi: Array  # (3,)
    curvature: Array  # (3, 3)
    velocity: Array | None = None  # (3,) in base_link; None: not known yet
    weight: float = 1.0
    blind: int = 0  # scans in a row that say nothing along some direction
    age: int = 0  # scans since it was found
    trusted: bool = False  # it was the one tracked

    def covariance(self, inflation: float) -> Array:
        """(3, 3) of x, y, yaw in map."""
        return np.asarray(inflation * (self.noise + self.error))


def seen(curvature: Array, ripple: float) -> tuple[Array, Array | None]:
    """What a scan tells of the position: (3, 3) projection onto it, and the direction (2,) it tells nothing of.

    Along a corridor without features a learned field still has ripples: walls tilted by ``ripple`` rad, which add about
    ripple² of the curvature across. Not clearly more than that is taken for none.
    """
    values, vectors = np.linalg.eigh(of_position(curvature))
    if values[0] >= (BLIND + RIPPLES * ripple**2) * values[1] and values[1] > 0:
        return np.eye(3), None
    keep, blind = np.eye(3), vectors[:, 0]
    keep[:2, :2] -= np.outer(blind, blind)
    return keep, blind


def project(evidence: Evidence, k: int, keep: Array) -> None:
    """Leave of the k-th evidence what `seen` keeps."""
    evidence.xi[k] = keep @ evidence.xi[k]
    for matrix in (evidence.curvature, evidence.of_noise, evidence.of_model):
        matrix[k] = keep @ matrix[k] @ keep


def found(
    pose: Array, evidence: Evidence, k: int, prior: Prior | None, volume: float, spread: Array, ripple: float
) -> Mode:
    """A mode of the search; of a direction that nothing is known of, ``spread`` (3, 3) remains.

    Without a prior every pose was as likely, in ``volume`` m² rad: complexity is the KL divergence from that.
    """
    keep, _ = seen(evidence.curvature[k], ripple)
    project(evidence, k, keep)
    information = prior.information[k] if prior else np.linalg.inv(spread)
    inverse = np.linalg.inv(evidence.curvature[k] + information)
    slope = evidence.xi[k] + (prior.information[k] @ difference(prior.mean[k : k + 1], pose[None])[0] if prior else 0)
    pose = pose + limited(inverse @ slope, MAX_STEP)
    pose[2] = se2.wrap(pose[2])
    noise = inverse @ (evidence.of_noise[k] + information) @ inverse
    error = inverse @ evidence.of_model[k] @ inverse
    accuracy = float(evidence.accuracy[k])
    logdet = float(np.linalg.slogdet(evidence.curvature[k] + information)[1])
    if prior:
        off = difference(pose[None], prior.mean[k : k + 1])[0]
        complexity = 0.5 * float(np.trace(information @ inverse) - 3 + off @ information @ off + logdet)
        complexity -= 0.5 * float(np.linalg.slogdet(information)[1])
    else:
        complexity = float(np.log(volume)) + 0.5 * (logdet - 3 * np.log(2 * np.pi * np.e))
    return Mode(
        pose, noise, error, float(evidence.explained[k]), accuracy, complexity, accuracy + complexity,
        evidence.xi[k], evidence.curvature[k],
    )  # fmt: skip


def moved(mode: Mode, fused: Fused, evidence: Evidence, k: int, period: float, *, blind: bool) -> Mode:
    """The mode after a scan: noise shrinks by the scan's information, the model's error is this scan's own."""
    inverse = np.linalg.inv(fused.information)
    information = fused.information - evidence.curvature[k]
    noise = inverse @ (evidence.of_noise[k] + information) @ inverse
    alone = np.linalg.inv(evidence.curvature[k] + np.eye(3))
    accuracy = float(evidence.accuracy[k])
    # Of a motion that is half unseen nothing is carried on.
    velocity = None
    if not blind and not mode.blind:
        velocity = smoothed(mode.velocity, se2.between(mode.pose, fused.mean) / period, period)
    energy = MEMORY * mode.energy + (1 - MEMORY) * (accuracy + fused.complexity)
    return Mode(
        fused.mean, noise, alone @ evidence.of_model[k] @ alone, float(evidence.explained[k]), accuracy,
        fused.complexity, energy, evidence.xi[k], evidence.curvature[k], velocity,
        blind=mode.blind + 1 if blind else 0, age=mode.age + 1, trusted=mode.trusted,
    )  # fmt: skip


def within(modes: list[Mode], bounds: tuple[float, float, float, float]) -> list[Mode]:
    """The modes, none outside the map, which goes from x0, y0 to x1, y1 (m)."""
    x0, y0, x1, y1 = bounds
    low, high = np.array([x0, y0, -np.inf]), np.array([x1, y1, np.inf])
    return [replace(mode, pose=np.clip(mode.pose, low, high)) for mode in modes]


def same(poses: Array, pose: Array) -> npt.NDArray[np.bool_]:
    """(N,) which of poses (N, 3) are the place that ``pose`` (3,) is."""
    off = np.abs(difference(poses, pose))
    return np.asarray((off[:, :2] < SAME_PLACE).all(axis=1) & (off[:, 2] < SAME_YAW))


def distinct(poses: Array, energy: Array, count: int) -> list[int]:
    """Indices of the ``count`` least energies, no two at the same place."""
    kept: list[int] = []
    for k in np.argsort(energy, kind="stable"):
        if not same(poses[kept], poses[k]).any():
            kept.append(int(k))
        if len(kept) == count:
            break
    return kept


def weigh(modes: list[Mode], evidence_error: float, count: int) -> list[Mode]:
    """Merged, weighed by energy, best first, refuted ones dropped.

    F between places is only known up to the model's error, a few beams at about 9 nats: ``evidence_error`` nats.
    """
    energy = np.array([mode.energy for mode in modes])
    holder = next((k for k, mode in enumerate(modes) if mode.trusted), None)
    if holder is not None:  # nobody goes before the place that was tracked but as `led` has it
        energy = np.maximum(energy, energy[holder])
        energy[holder] = np.nextafter(energy[holder], -np.inf)
    kept = distinct(np.array([mode.pose for mode in modes]), energy, count)
    ordered = [modes[k] for k in kept]
    weights = np.exp(-(energy[kept] - energy[kept[0]]) / evidence_error)
    weights /= weights.sum()
    return [
        replace(mode, weight=float(weight / weights[weights > NEGLIGIBLE].sum()))
        for mode, weight in zip(ordered, weights, strict=True)
        if weight > NEGLIGIBLE
    ]


def led(modes: list[Mode], settings: Settings) -> list[Mode]:
    """The hypotheses by weight; who was tracked leads until another has proven itself."""
    holder = next((mode for mode in modes if mode.trusted), None)
    if holder is not None and any(succeeds(mode, holder, settings) for mode in modes):
        modes = [replace(mode, trusted=False) for mode in modes]
    return weigh(modes, settings.evidence_error, settings.hypotheses)


def succeeds(rival: Mode, holder: Mode, settings: Settings) -> bool:
    """Whether the robot was carried to where ``rival`` is, not only its surroundings changed.

    One scan of a place that changed may look like another place, by hundreds of nats; scans from several places do not.
    """
    soon = GOOD_SCANS if rival.explained >= settings.good else settings.probation
    proven = rival.age >= soon or rival.explained >= settings.satisfied
    return proven and rival.energy < holder.energy - 3 * settings.evidence_error
