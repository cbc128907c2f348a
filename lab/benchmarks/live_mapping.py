"""Drives the simulated robot of a session that maps, and measures the errors: `python -m lab.benchmarks.live_mapping`.

The driver knows the world and the true pose, and drives by hand as the page does: it publishes `drive` messages.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from common.bus.bus import Bus, open_bus
from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import load_world
from common.messages.definitions import Belief, Drive, Health, Map, Truth, Twist
from common.messages.topics import BELIEF, DRIVE, HEALTH, MAP, TRUTH
from lab.accuracy.scenes import Scene
from lab.benchmarks.mapping import trajectory_errors
from lab.statistics import root_mean_square
from presage.live.latest_messages import LatestMessages
from presage.session.running_sessions import link_of

GAIN = 3.0  # 1/s, commanded speed per distance from the next point of the path
REACHED_M = 0.25  # distance from a point at which the robot turns to the next one
MAX_SPEED, MAX_TURN = 0.7, 1.0  # m/s, rad/s
TIMEOUT_S = 5.0
STUCK_NS = 60_000_000_000  # without reaching a new point


def random_path(world: str, seconds: float, seed: int, start: Array) -> Array:
    """Poses (N, 3) of a drive between random places of a world, from ``start`` (3,)."""
    return Scene.of(load_world(world), 2, seed).path(seconds, MAX_SPEED, start)


def drive_path(bus: Bus, path: Array) -> tuple[Array, Array]:
    """Drives along poses (N, 3); waits at each until the robot is near.

    Returns beliefs and true poses (M, 3) of the same scans, each in its own frame. Raises UserError if no truth comes.
    """
    messages, truths, pairs, k = LatestMessages(bus, TRUTH, BELIEF), dict[int, Array](), [], 0
    progress_ns = 0  # stamp at which the robot was last near a new point of the path
    while k + 1 < len(path):
        message = messages.next(TIMEOUT_S)
        if message is None:
            raise UserError(f"no message came for {TIMEOUT_S:g} s: is a simulator running?")
        if isinstance(message, Belief) and message.stamp_ns in truths:
            pairs.append((message.pose.array(), truths[message.stamp_ns]))
        if not isinstance(message, Truth):
            continue
        truths[message.stamp_ns] = pose = message.pose.array()
        progress_ns = progress_ns or message.stamp_ns
        while k + 1 < len(path) and np.hypot(*(path[k] - pose)[:2]) < REACHED_M:
            k, progress_ns = k + 1, message.stamp_ns
        if message.stamp_ns - progress_ns > STUCK_NS:
            raise UserError(f"the robot is stuck at ({pose[0]:.2f}, {pose[1]:.2f})")
        vx, vy, wz = GAIN * se2.between(pose, path[k])
        slower = min(1.0, MAX_SPEED / max(float(np.hypot(vx, vy)), 1e-9))
        twist = Twist(vx=slower * vx, vy=slower * vy, wz=float(np.clip(wz, -MAX_TURN, MAX_TURN)))
        bus.put(DRIVE, Drive(stamp_ns=message.stamp_ns, seq=k, twist=twist).encode())
    beliefs, true = (np.array(each) for each in zip(*pairs, strict=True))
    return beliefs, true


def main() -> None:
    """Drives along a random path, and prints errors and dropped scans."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="office", help="the world of the simulator")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--connect", default="")
    args = parser.parse_args()
    with open_bus(link_of(args.connect, "")) as bus:
        began = time.monotonic()
        first = LatestMessages(bus, TRUTH).wait_for(Truth, lambda _: True, TIMEOUT_S)
        if first is None:
            raise UserError("no truth comes: is a simulator running?")
        path = random_path(args.world, args.seconds, args.seed, first.pose.array())
        position, heading = trajectory_errors(*drive_path(bus, path))
        print(
            f"{len(position)} beliefs in {time.monotonic() - began:.0f} s: "
            f"{root_mean_square(position) * 1e3:.1f} mm RMS, at most {position.max() * 1e3:.0f} mm; "
            f"{np.rad2deg(heading).mean():.3f} degrees in the mean"
        )
        messages = LatestMessages(bus, MAP, HEALTH)
        health = messages.wait_for(Health, lambda message: message.service == "mapper", TIMEOUT_S)
        if health is not None:
            dropped = {row.key.rpartition("/")[2]: row.dropped for row in health.topics if row.dropped}
            print(f"mapper: dropped {dropped or 'nothing'}, counters {health.counters}")
        grown = messages.wait_for(Map, lambda _: True, 2 * TIMEOUT_S)
        if grown is not None:
            print(f"{len(grown.poses)} key scans, {len(grown.closures) // 2} loop closures")


if __name__ == "__main__":
    main()
