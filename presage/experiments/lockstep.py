"""One journey through the real processes: router, simulator, estimator, controller, in lockstep over zenoh.

All but the router are started anew for every journey: so the numbers depend on the errand alone, not on what ran
before. In lockstep each scan waits for the command that answers it, so the machine's speed does not count either.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from common.bus import open_bus, wait_until
from common.errors import UserError
from common.messages import Belief, Goal, Pose, Stamped, Status, Truth
from common.se2 import Array
from common.topics import BELIEF, GOAL, STATUS, TRUTH
from presage.experiments.journeys import CLOSE, Journey
from presage.stack import Stack
from presage.watch import Watch
from presage.workers import ONE_CORE

OURS = "experiment"  # our liveliness token: the simulator waits for it, so the goal is there before the first scan
PATIENCE = 120.0  # s of wall time without a message
ROUTERS = 5  # tries: between finding a free port and listening on it somebody else may take it


@dataclass(frozen=True)
class Errand:
    """Everything a run depends on."""

    journey: Journey
    yaw: float  # rad, kept throughout
    world: str
    beams: int
    seed: int
    estimator: tuple[str, ...]  # arguments of the estimator's command line
    limit: int  # iterations after which it is given up


@dataclass
class Track:
    """What happened, one entry a scan; the first is before any motion."""

    truths: list[Truth] = field(default_factory=list)
    beliefs: list[Belief] = field(default_factory=list)

    def path(self) -> Array:
        """(N, 3) true poses."""
        return np.array([truth.pose.array() for truth in self.truths])

    def believed(self) -> Array:
        """(N, 3) poses of the beliefs about the same scans."""
        return np.array([belief.pose.array() for belief in self.beliefs])


@contextmanager
def session() -> Iterator[Stack]:
    """A router of our own for runs one after another; whatever happens, no process is left."""
    # Nobody's own settings change the experiment; one thread each, for sums depend on how they are split.
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PRESAGE_")}
    environment = clean | dict.fromkeys(ONE_CORE, "1")
    for left in reversed(range(ROUTERS)):
        with Stack("e3", quiet=True, environment=environment) as stack:
            try:
                stack.start_router()
            except UserError:
                if not left:
                    raise
                continue
            yield stack
            return


def run(errand: Errand, stack: Stack) -> Track:
    """Until the robot truly is `CLOSE` to the goal, or ``limit`` scans were answered; ends what it started."""
    # A name nobody else has: neither an earlier run's last messages nor another session's are heard.
    stack.robot = f"e3-{os.getpid()}-{time.monotonic_ns()}"
    (x, y), yaw = errand.journey.start, float(np.rad2deg(errand.yaw))
    pose, world, seed = f"{x!r},{y!r},{yaw!r}", ("--world", errand.world), ("--seed", str(errand.seed))
    with open_bus(stack.link()) as bus:
        watch = Watch(bus, TRUTH, BELIEF, STATUS)
        stack.start("controller", *world, "--preset", "paper", "--belief-timeout", "60")
        stack.start("estimator", *world, *seed, "--initial-pose", pose, *errand.estimator)
        stack.start(
            "simulator", *world, *seed, "--start", pose, "--beams", str(errand.beams), "--pace", "lockstep",
            "--wait-for", f"estimator,controller,{OURS}",
        )  # fmt: skip
        stack.wait_alive(bus)
        _give(watch, stack, Goal(stamp_ns=0, seq=1, pose=Pose(x=errand.journey.goal[0], y=errand.journey.goal[1])))
        bus.declare_alive(OURS)
        track = _follow(watch, stack, np.array(errand.journey.goal), errand.limit)
    for name in ("controller", "estimator", "simulator"):
        stack.stop(name)
    return track


def _give(watch: Watch, stack: Stack, goal: Goal) -> None:
    """Until the controller says that it has the goal; sent again, for a message on a new key may be lost."""

    def taken() -> bool:
        stack.check()
        watch.bus.put(GOAL, goal.encode())
        status = watch.until(Status, lambda s: s.goal_seq == goal.seq, 1.0)
        if status is not None and status.state == "blocked":
            raise UserError(status.reason)
        return status is not None

    watch.bus.wait_matching(GOAL, 10.0)
    if not wait_until(taken, PATIENCE, 0.0):
        raise UserError(f"the controller did not take the goal within {PATIENCE:g} s")


def _follow(watch: Watch, stack: Stack, goal: Array, limit: int) -> Track:
    """Truths and beliefs of every scan, once each: what is sent again carries a stamp that is known."""
    track, heard, there = Track(), time.monotonic(), False
    while not there or len(track.beliefs) < len(track.truths):
        message = watch.next(0.5)
        if message is None:
            stack.check()
            if time.monotonic() - heard > PATIENCE:
                raise UserError(f"no scan was answered within {PATIENCE:g} s, after {len(track.beliefs)} scans")
            continue
        heard = time.monotonic()
        if isinstance(message, Truth) and not there and _is_next(track.truths, message):
            track.truths.append(message)
            away = float(np.hypot(*(message.pose.array()[:2] - goal)))
            there = away <= CLOSE or len(track.truths) > limit
        elif isinstance(message, Belief) and _is_next(track.beliefs, message):
            track.beliefs.append(message)
    return Track(track.truths, track.beliefs[: len(track.truths)])


def _is_next(kept: Sequence[Stamped], message: Stamped) -> bool:
    """Whether it is new; raises UserError where one between is missing."""
    if kept and message.stamp_ns <= kept[-1].stamp_ns:
        return False
    period = kept[1].stamp_ns - kept[0].stamp_ns if len(kept) > 1 else None
    if (not kept and message.stamp_ns != 0) or (period and message.stamp_ns - kept[-1].stamp_ns != period):
        raise UserError(f"a message is missing before the {type(message).__name__} of {message.stamp_ns} ns")
    return True
