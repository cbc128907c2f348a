"""The front end: the motion between scans, from each scan's registration to the last key scans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.geometry import se2
from common.geometry.se2 import Array
from presage.mapping.drive import RawDrive
from presage.mapping.elements import Elements, elements_of_scan, joined
from presage.mapping.pose_graph import Link
from presage.mapping.registration import Registration, Surface, register
from presage.mapping.search import search

KEY_DISTANCE_M, KEY_TURN_RAD = 0.4, 0.5  # from the last key scan, before another one is taken
SEARCH_WINDOW, SEARCH_RANGE_M = np.array([0.3, 0.3, 0.4]), 10.0  # around the prior; of the elements that take part
LOCAL_SCANS = 12  # key scans in the local map
MIN_SHARE = 0.2  # of a scan's elements that must match the local map
# A scan of which less matches sees something new; it becomes a key scan earlier, after this share of the way.
FAMILIAR_SHARE, EARLY = 0.7, 0.25
# Standard deviations of the motion. With odometry: of its error, as a share of the motion. Without: of the change of
# the velocity in one second, m/s and rad/s, and of the velocity itself where the last one is unknown.
ODOMETRY_PATH, ODOMETRY_TURN_BY_PATH, ODOMETRY_TURN = 0.4, 0.5, 1.0  # m/m, rad/m, rad/rad
STANDING = np.array([0.002, 0.002, 0.002])  # m, m, rad
ACCELERATION = np.array([1.0, 1.0, 3.0])
MAX_VELOCITY = np.array([1.0, 1.0, 1.5])
# Errors of a registration that do not average out, for each key scan: moving things, the surfaces' roughness.
REGISTRATION = np.array([0.005, 0.005, 0.002])


@dataclass(frozen=True)
class Track:
    """The drive as the front end sees it: exact over some metres, drifting beyond."""

    poses: Array  # (N, 3) of all scans
    keys: list[int]  # scans that are key scans
    elements: list[Elements]  # of the key scans
    links: list[Link]  # between key scans, by their number among the key scans
    lost: int  # scans that did not match


def track(drive: RawDrive, report: Callable[[float], None] = lambda _done: None) -> Track:
    """Tracks the scans of a drive."""
    poses, keys, kept, links, lost = np.zeros((len(drive.ranges), 3)), [], [], [], 0
    surface: Surface | None = None
    velocity: Array | None = None
    since_key = np.zeros((3, 3))  # covariance of the motion since the last key scan, by the motion model alone
    for k, ranges in enumerate(drive.ranges):
        elements = elements_of_scan(ranges, drive.angles, drive.mount, drive.range_max)
        if surface is None:
            keys, kept, surface = [k], [elements], Surface(elements)
            continue
        motion, deviation = _motion(drive, k, velocity)
        prior = se2.compose(poses[k - 1], motion)
        _, by_step = se2.compose_jacobians(poses[k - 1], motion)
        covariance = (by_step * deviation**2) @ by_step.T
        found = _best_registration(surface, elements, prior, covariance)
        period = drive.stamps[k] - drive.stamps[k - 1]
        if found is None or found.share < MIN_SHARE:
            poses[k], lost, information = prior, lost + 1, np.zeros((3, 3))
            velocity = velocity if drive.odom is None else None
        else:
            poses[k], information = found.pose, found.information
            velocity = se2.between(poses[k - 1], poses[k]) / period
        since_key = since_key + covariance
        off = se2.between(poses[keys[-1]], poses[k])
        way = max(np.hypot(off[0], off[1]) / KEY_DISTANCE_M, abs(off[2]) / KEY_TURN_RAD)
        if way < (EARLY if found is not None and found.share < FAMILIAR_SHARE else 1.0):
            continue
        links.append(_link(len(keys) - 1, poses[keys[-1]], poses[k], information, since_key))
        keys.append(k)
        kept.append(elements)
        local = [each.moved(poses[key]) for key, each in zip(keys[-LOCAL_SCANS:], kept[-LOCAL_SCANS:], strict=True)]
        surface, since_key = Surface(joined(local)), np.zeros((3, 3))
        report(k / len(poses))
    return Track(poses, keys, kept, links, lost)


def _best_registration(surface: Surface, elements: Elements, prior: Array, covariance: Array) -> Registration | None:
    """Registers a scan from the prior (3,), (3, 3), and from the results of a search if much of it does not match."""
    information = np.asarray(np.linalg.inv(covariance), float)
    found = register(surface, elements, prior, information)
    if found is not None and found.share > FAMILIAR_SHARE:
        return found
    near = elements.part(np.hypot(*elements.points.T) < SEARCH_RANGE_M)
    if not len(near):
        return found
    others = [
        register(surface, elements, start, None) for start in search(surface.elements, near, prior, SEARCH_WINDOW)
    ]
    matches = [each for each in (found, *others) if each is not None]
    return max(matches, key=lambda each: each.share, default=None)


def _motion(drive: RawDrive, k: int, velocity: Array | None) -> tuple[Array, Array]:
    """Motion (3,) in base_link since the scan before, and its standard deviations (3,)."""
    period = float(drive.stamps[k] - drive.stamps[k - 1])
    if drive.odom is not None:
        motion = se2.between(drive.odom[k - 1], drive.odom[k])
        moved, turned = np.hypot(motion[0], motion[1]), abs(motion[2])
        path, turn = ODOMETRY_PATH * moved, ODOMETRY_TURN_BY_PATH * moved + ODOMETRY_TURN * turned
        return motion, STANDING + np.array([path, path, turn])
    if velocity is None:
        return np.zeros(3), STANDING + MAX_VELOCITY * period
    return velocity * period, STANDING + np.minimum(ACCELERATION * period, MAX_VELOCITY) * period


def _link(number: int, first: Array, second: Array, information: Array, motion: Array) -> Link:
    """The link between two successive key scans; ``information`` and ``motion`` are in the frame of the track."""
    covariance = np.linalg.inv(information + np.linalg.inv(motion))
    turn = np.eye(3)
    turn[:2, :2] = se2.rotate(float(first[2]), np.eye(2))
    covariance = turn @ covariance @ turn.T + np.diag(REGISTRATION**2)
    return Link(number, number + 1, se2.between(first, second), np.linalg.inv(covariance))
