"""Learns the distance field from posed scans.

1. Points where beams end are pooled in cells; their covariance gives a surface element (mean, normal) for each cell.
2. phi near surfaces is the weighted distance to the elements around (implicit moving least squares, Kolluri 2008);
   elsewhere the distance to the nearest surface.
3. Sweeps of prediction: phi moves, where beams end, along the gradient of the squared prediction error (diagonal
   Gauss-Newton steps), as perception moves the belief.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.geometry.se2 import Array, compose, wrap
from services.estimator.precise.field import CLASSES, SEEN_CELL, DistanceField, Floats, Seen
from services.estimator.precise.learning.surfaces import LEVEL_POINTS, PRESENT, THROUGH, Beams, in_company, surfaces
from services.estimator.shared import kernels
from services.estimator.shared.generative_models import CORNER

CARVED = 0.5  # cells from a surface, at least, of a node that beams go through
EM_STEPS, OUTLIER, FLAT = 15, 0.1, 25.0  # FLAT: m over which the flat part of the density extends
CLIP = 0.1  # m, a larger error is another surface's
GRAZING = 0.15  # least |n . u| of a beam that shapes the field
RARE, RARE_SCALE = 20, 0.05  # a class seen seldom: as if it had been seen so often, with this error (m), besides
LEAST_SCALE = 1e-3  # m


@dataclass(frozen=True)
class Recipe:
    """What learning depends on, besides the samples."""

    resolution: float = 0.04  # m
    sweeps: int = 10
    beams_a_sweep: int = 2_000_000
    seed: int = 0


def learn_field(
    beams: Beams,
    recipe: Recipe,
    report: Callable[[str, float], None] = lambda _title, _done: None,
) -> DistanceField:
    """The field that predicts the beams; ``report`` hears of stages and the share done."""
    report("surfaces", 0.0)
    beams = beams.part(in_company(beams.ends()))
    field = surfaces(beams, recipe.resolution)
    rng = np.random.default_rng(recipe.seed)
    phi = field.phi.copy()
    for sweep in range(recipe.sweeps):
        report("prediction errors", sweep / recipe.sweeps)
        some = rng.integers(0, len(beams.ranges), min(recipe.beams_a_sweep, len(beams.ranges)))
        rate = 1 / (1 + sweep / 2)  # falls, so that the noise of the last sweeps averages out
        phi = _descend(DistanceField(phi, field.origin, field.resolution), beams.part(some), rate)
    return DistanceField(phi, field.origin, field.resolution)


def looked_into(beams: Beams) -> Seen:
    """The cells that the beams have passed or ended in."""
    ends = beams.ends()
    low = np.minimum(ends.min(0), beams.starts.min(0)) - SEEN_CELL
    shape = np.ceil((np.maximum(ends.max(0), beams.starts.max(0)) - low) / SEEN_CELL).astype(int)[::-1] + 1
    cells = np.zeros(shape, np.bool_)
    kernels.look(beams.starts - low, beams.unit(), beams.ranges, SEEN_CELL, cells)
    return Seen(cells, (float(low[0]), float(low[1])))


def reachable(field: DistanceField, visited: Array, clearance: float = 0.1, seen: Seen | None = None) -> Array:
    """(K, 2) m in map: nodes at least ``clearance`` m from surfaces that hang together with visited places (N, 2)."""
    free = field.phi > clearance
    if seen is not None:
        free &= seen.at(field)
    grown = np.zeros_like(free)
    node = np.round((visited - field.origin) / field.resolution).astype(int)
    grown[node[:, 1], node[:, 0]] = True
    grown &= free
    while True:
        wider = grown.copy()
        wider[1:] |= grown[:-1]
        wider[:-1] |= grown[1:]
        wider[:, 1:] |= grown[:, :-1]
        wider[:, :-1] |= grown[:, 1:]
        wider &= free
        if (wider == grown).all():
            break
        grown = wider
    i, j = np.nonzero(grown)
    return np.asarray(np.array(field.origin) + field.resolution * np.column_stack([j, i]))


def learn_ripple(field: DistanceField, lasers: Array, angles: Array, apart: int = 10) -> float:
    """Rad by which normals of flat surfaces err: of a beam's against the mean of those ``apart`` beams to its sides.

    Beyond 0.3 rad it is a corner, not a ripple.
    """
    normal = field.trace(lasers, angles).jacobian[..., :2]
    yaw = np.arctan2(normal[..., 1], normal[..., 0])
    left, right = (
        wrap(yaw[:, shift : yaw.shape[1] - 2 * apart + shift] - yaw[:, apart:-apart]) for shift in (0, 2 * apart)
    )
    flat = (np.abs(left) < CORNER) & (np.abs(right) < CORNER)
    # The mean of two errors less one's own: 1.5 times the variance of one.
    return float(np.sqrt(np.mean(((left + right)[flat] / 2) ** 2) / 1.5)) if flat.any() else 0.0


def _descend(field: DistanceField, beams: Beams, rate: float) -> Floats:
    """One sweep: dr = dphi / |n . u|, so an error e = o - r asks for e |n . u| where the beam ends, by 1 / |n . u|²."""
    traced = field.trace(np.column_stack([beams.starts, beams.directions]), np.zeros(1))
    ranges, facing = traced.ranges[:, 0], traced.facing[:, 0]
    error = beams.ranges - ranges
    good = np.isfinite(ranges) & (np.abs(error) < CLIP) & (facing > GRAZING)
    field = _carved(field, beams, ranges, good, np.where(np.isfinite(ranges), error, 0.0) * facing)
    facing = facing[good]
    where = (beams.starts[good] + ranges[good, None] * beams.unit()[good] - field.origin) / field.resolution
    node = np.minimum(np.maximum(where.astype(int), 0), np.array(field.phi.shape)[::-1] - 2)
    u, v = (where - node).T
    ny, nx = field.phi.shape
    up, norm = np.zeros(ny * nx), np.zeros(ny * nx)
    for di, dj, w in ((0, 0, (1 - u) * (1 - v)), (0, 1, u * (1 - v)), (1, 0, (1 - u) * v), (1, 1, u * v)):
        index = (node[:, 1] + di) * nx + node[:, 0] + dj
        up += np.bincount(index, w * error[good] / facing, ny * nx)
        norm += np.bincount(index, w / facing**2, ny * nx)
    step = np.divide(up, norm + 1.0, out=np.zeros_like(up))
    return np.asarray(field.phi + rate * step.reshape(ny, nx), np.float32)


def _carved(field: DistanceField, beams: Beams, ranges: Array, hit: np.ndarray, behind: Array) -> DistanceField:
    """The field with what most beams went through taken out: planes carried on past an edge, things that moved away.

    ``behind`` (R,) m: how far behind the surface a beam ended, across it.
    """
    through = np.isfinite(ranges) & (behind > THROUGH)
    counts = []
    for which in (hit, through):
        where = (beams.starts[which] + ranges[which, None] * beams.unit()[which] - field.origin) / field.resolution
        node = np.clip(np.round(where).astype(int), 0, np.array(field.phi.shape)[::-1] - 1)
        counts.append(np.bincount(node[:, 1] * field.phi.shape[1] + node[:, 0], minlength=field.phi.size))
    ended, went = (count.reshape(field.phi.shape) for count in counts)
    absent = (went >= LEVEL_POINTS) & (ended < PRESENT * (ended + went))
    phi = np.where(absent, np.maximum(field.phi, CARVED * field.resolution), field.phi).astype(np.float32)
    return DistanceField(phi, field.origin, field.resolution)


def learn_scales(field: DistanceField, poses: Array, mount: Array, angles: Array, ranges: Array, sigma: float) -> Array:
    """The model's own error (m) in each class of beams, from scans (N, B) it has not learned from: learned precision.

    Expectation maximisation of the likelihood's density, whose flat part takes what misses.
    """
    traced = field.trace(compose(poses, mount), angles)
    both = np.isfinite(ranges) & np.isfinite(traced.ranges)
    square, kind = (ranges[both] - traced.ranges[both]) ** 2, traced.classes()[both]
    size = int(np.prod(CLASSES))
    variance = np.full(size, RARE_SCALE**2)
    for _ in range(EM_STEPS):
        s2 = variance[kind] + sigma**2
        core = (1 - OUTLIER) * np.exp(-0.5 * square / s2) / np.sqrt(2 * np.pi * s2)
        inlier = core / (core + OUTLIER / FLAT)
        count, total = np.bincount(kind, inlier, size), np.bincount(kind, inlier * square, size)
        variance = np.maximum((total + RARE * (RARE_SCALE**2 + sigma**2)) / (count + RARE) - sigma**2, LEAST_SCALE**2)
    return np.asarray(np.sqrt(variance))
