"""The tasks: one estimator through one kind of scene."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from lab.accuracy import bound
from lab.accuracy.scenes import Scene, twin_of, twin_path
from services.estimator.shared.interface import Observation, PoseEstimator, Posterior
from services.simulator.odometry import Odometer, OdometryNoise

FOUND_DISTANCE, FOUND_YAW = 0.2, np.deg2rad(5)  # m, rad; an estimate with smaller errors counts as found
STANDING_SCANS = 20
# From this scan on, a belief must contain both of two identical rooms. Before, an estimator may still be searching.
TWINS_REQUIRED_FROM_SCAN = 20
DEPENDENT_SCANS = 75  # of one path; estimates farther apart are taken as independent


def is_at(believed: Array, pose: Array) -> bool:
    """Whether the poses (3,) differ by less than `FOUND_DISTANCE` and `FOUND_YAW`."""
    dx, dy, turn = believed - pose
    return bool(np.hypot(dx, dy) < FOUND_DISTANCE and abs(se2.wrap(turn)) < FOUND_YAW)


@dataclass
class TaskOutcome:
    """Results of one estimator in one task."""

    errors: list[Array] = field(default_factory=list)  # (3,) m, m, rad, of the estimates found
    groups: list[int] = field(default_factory=list)  # of these, which depend on each other if they are in one
    all_position_errors: list[float] = field(default_factory=list)  # m, of all estimates
    nees: list[float] = field(default_factory=list)  # NEES: error' covariance^-1 error, with the estimate's covariance
    bounds: list[float] = field(default_factory=list)  # m, Cramér-Rao bound of the position
    update_ms: list[float] = field(default_factory=list)  # processor time
    found: int = 0
    total: int = 0
    wrong: int = 0  # estimates in state `tracking` while the robot was elsewhere
    independent: bool = True  # whether the counts are of separate trials, not of scans along one path

    @classmethod
    def joined(cls, parts: Sequence[TaskOutcome]) -> TaskOutcome:
        """The results of several seeds."""
        joined = cls(independent=parts[0].independent)
        for part in parts:
            first = max(joined.groups, default=-1) + 1
            joined.groups += [first + group for group in part.groups]
            joined.errors += part.errors
            joined.all_position_errors += part.all_position_errors
            joined.nees += part.nees
            joined.bounds += part.bounds
            joined.update_ms += part.update_ms
            joined.found += part.found
            joined.total += part.total
            joined.wrong += part.wrong
        return joined

    def by_group(self, values: Array) -> list[Array]:
        """``values`` (N,), one for each error, in groups that do not depend on each other."""
        groups = np.array(self.groups, int)
        return [values[groups == group] for group in np.unique(groups)]

    def add(self, posterior: Posterior, pose: Array, limit: float | None) -> bool:
        """Records an estimate. Returns whether it is at the true ``pose``; ``limit`` is the position bound in m."""
        error = posterior.pose - pose
        error[2] = se2.wrap(error[2])
        found_here = is_at(posterior.pose, pose)
        self.total += 1
        self.found += found_here
        self.wrong += posterior.state == "tracking" and not found_here
        self.all_position_errors.append(float(np.hypot(error[0], error[1])))
        if found_here:
            self.errors.append(error)
            self.groups.append((self.total - 1) // (1 if self.independent else DEPENDENT_SCANS))
            if limit is not None:
                self.bounds.append(limit)
            if posterior.covariance is not None:
                self.nees.append(float(error @ np.linalg.solve(posterior.covariance, error)))
        return found_here


def _timed_update(estimator: PoseEstimator, observation: Observation, outcome: TaskOutcome | None = None) -> Posterior:
    began = time.process_time()
    posterior = estimator.update(observation)
    if outcome is not None:
        outcome.update_ms.append((time.process_time() - began) * 1e3)
    return posterior


def standing(estimator: PoseEstimator, scene: Scene, trials: int) -> dict[str, TaskOutcome]:
    """Global localisation of a standing robot, without odometry: after one scan and after twenty."""
    one, many = TaskOutcome(), TaskOutcome()
    poses = scene.poses(trials)
    limits = bound.position(bound.single(scene, poses))
    for pose, clean, limit in zip(poses, scene.clean(poses), limits, strict=True):
        _stand(estimator, scene, pose, clean, (one, many), limit)
    return {"from nothing, 1 scan": one, "standing, 20 scans": many}


def _stand(
    estimator: PoseEstimator,
    scene: Scene,
    pose: Array,
    clean: Array,
    outcomes: tuple[TaskOutcome, TaskOutcome],
    limit: float | None = None,
) -> None:
    """Localises a standing robot from an unknown start; ``outcomes`` are those after one scan and after all.

    ``clean`` (B,) m is the scan without noise, ``limit`` the bound of the position error in m after one scan.
    """
    one, many = outcomes
    estimator.restart()
    for k in range(STANDING_SCANS):
        posterior = _timed_update(estimator, scene.observe(clean, k / scene.scanner.rate), one if k == 0 else many)
        if k == 0:
            one.add(posterior, pose, limit)
    many.add(posterior, pose, None if limit is None else limit / np.sqrt(STANDING_SCANS))


def blocked(estimator: PoseEstimator, scene: Scene, trials: int) -> dict[str, TaskOutcome]:
    """Global localisation with 30 % of the beams shortened by unknown obstacles: after one scan and after twenty.

    The obstacles are drawn once per trial.
    """
    one, many = TaskOutcome(), TaskOutcome()
    poses = scene.poses(trials)
    for pose, clean in zip(poses, scene.clean(poses), strict=True):
        _stand(estimator, scene, pose, scene.blocked(clean, 0.3), (one, many))
    return {"30 % blocked, 1 scan": one, "30 % blocked, 20 scans": many}


def furnished(estimator: PoseEstimator, scene: Scene, trials: int) -> dict[str, TaskOutcome]:
    """Global localisation with 30 % of the beams changed by furniture and glass that the map lacks."""
    one, many = TaskOutcome(), TaskOutcome()
    for pose in scene.poses(trials):
        _stand(estimator, scene, pose, scene.furnished(pose, 0.3), (one, many))
    return {"30 % furniture, 1 scan": one, "30 % furniture, 20 scans": many}


def tracking(estimator: PoseEstimator, scene: Scene, seconds: float, *, odometry: bool) -> dict[str, TaskOutcome]:
    """Tracking along a path from a known start, with the simulator's odometry or without."""
    outcome, path = TaskOutcome(independent=False), scene.path(seconds)
    # Without odometry the motion is unknown, so the bound is that of each scan alone.
    limits = bound.recursive(scene, path, OdometryNoise()) if odometry else bound.single(scene, path)
    odometer = Odometer(OdometryNoise(), scene.rng)
    estimator.restart(path[0], np.diag([0.01, 0.01, 0.01]))
    for k, pose in enumerate(path):
        if k:
            odometer.move(path[k - 1], pose)
        observation = scene.observe(
            scene.clean(pose[None])[0], k / scene.scanner.rate, odometer.pose.copy() if odometry else None
        )
        outcome.add(_timed_update(estimator, observation, outcome), pose, float(bound.position(limits[k])))
    return {"tracking, odometry" if odometry else "tracking, no odometry": outcome}


def kidnapped(estimator: PoseEstimator, scene: Scene, trials: int) -> dict[str, TaskOutcome]:
    """Teleports of a standing robot every 20 scans: whether it is found after one, three and twenty scans."""
    after = {1: TaskOutcome(), 3: TaskOutcome(), 20: TaskOutcome()}
    poses, stamp = scene.poses(trials + 1), 0
    estimator.restart()
    for number, (pose, clean) in enumerate(zip(poses, scene.clean(poses), strict=True)):
        for k in range(1, STANDING_SCANS + 1):
            stamp += 1
            posterior = _timed_update(estimator, scene.observe(clean, stamp / scene.scanner.rate))
            if number and k in after:
                after[k].add(posterior, pose, None)
    return {f"kidnapped, {k} scan{'s' if k > 1 else ''}": outcome for k, outcome in after.items()}


def holds_both(posterior: Posterior, pose: Array) -> bool:
    """Whether hypotheses lie at ``pose`` (3,) and at its twin in the other room."""
    return all(any(is_at(h.pose, place) for h in posterior.hypotheses) for place in (pose, twin_of(pose)))


def twins(estimator: PoseEstimator, scene: Scene, trials: int) -> dict[str, TaskOutcome]:
    """A path out of one of two identical rooms: both kept while ambiguous, and the right one believed at the end.

    "Both kept" counts trials in which every belief from the 20th scan until the first scan that distinguishes the rooms
    has a hypothesis at the true pose and one at its twin, of any weight. Its ``wrong`` counts trials that published
    `tracking` at the wrong place during that time.
    """
    kept, right = TaskOutcome(), TaskOutcome()
    for _ in range(trials):
        path, same = twin_path(scene)
        estimator.restart()
        both, wrong = True, False
        for k, pose in enumerate(path):
            posterior = _timed_update(estimator, scene.observe(scene.clean(pose[None])[0], k / scene.scanner.rate))
            if k >= same:
                continue
            wrong |= posterior.state == "tracking" and not is_at(posterior.pose, pose)
            if k + 1 >= TWINS_REQUIRED_FROM_SCAN:
                both &= holds_both(posterior, pose)
        kept.total, kept.found, kept.wrong = kept.total + 1, kept.found + both, kept.wrong + wrong
        right.add(posterior, pose, None)
    return {"two rooms alike: both kept": kept, "two rooms alike: right after": right}
