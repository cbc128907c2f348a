"""One journey through real processes in lockstep.

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

from common.bus.bus import open_bus, wait_until
from common.errors import UserError
from common.geometry.se2 import Array
from common.messages.definitions import Belief, Goal, Health, Pose, Preference, Stamped, Status, Truth
from common.messages.topics import BELIEF, GOAL, HEALTH, PREFERENCE, STATUS, TRUTH
from lab.experiments.journeys import CLOSE, Journey
from lab.workers import THREAD_COUNT_VARIABLES
from presage.live.bus_watch import Watch
from presage.session.stack import Stack

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
    controller: tuple[str, ...] = ("--preset", "paper")  # arguments of the controller's command line
    simulator: tuple[str, ...] = ()  # and of the simulator's
    known: bool = True  # the belief begins at the true start
    told: bool = False  # it ends when the controller says `reached`, or refuses; else when the robot truly is there


@dataclass
class Track:
    """What happened, one entry a scan; the first is before any motion."""

    truths: list[Truth] = field(default_factory=list)
    beliefs: list[Belief] = field(default_factory=list)
    statuses: dict[int, Status] = field(default_factory=dict)  # the last of each stamp, ns
    plans: list[int] = field(default_factory=list)  # ns, when the goal prior was made anew
    health: Health | None = None  # of the controller, the last that was heard
    failure: str = ""  # why it was cut short

    def path(self) -> Array:
        """(N, 3) true poses."""
        return np.array([truth.pose.array() for truth in self.truths])

    def believed(self) -> Array:
        """(N, 3) poses of the beliefs about the same scans."""
        return np.array([belief.pose.array() for belief in self.beliefs])

    def has(self, stamp_ns: int) -> bool:
        """Whether truth and belief of that scan are there."""
        return all(bool(of) and of[-1].stamp_ns >= stamp_ns for of in (self.truths, self.beliefs))

    def cut(self, stamp_ns: int) -> None:
        """Forget what came after."""
        self.truths = [each for each in self.truths if each.stamp_ns <= stamp_ns]
        self.beliefs = [each for each in self.beliefs if each.stamp_ns <= stamp_ns]
        self.statuses = {stamp: each for stamp, each in self.statuses.items() if stamp <= stamp_ns}


@contextmanager
def session() -> Iterator[Stack]:
    """A router of our own for runs one after another; whatever happens, no process is left."""
    # Nobody's own settings change the experiment; one thread each, for sums depend on how they are split.
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PRESAGE_")}
    environment = clean | dict.fromkeys(THREAD_COUNT_VARIABLES, "1")
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
    """Until the robot is at the goal, or ``limit`` scans were answered; ends what it started.

    Raises UserError where it goes wrong; an errand that is ``told``, once under way, has a ``failure`` instead.
    """
    # A name nobody else has: neither an earlier run's last messages nor another session's are heard.
    stack.robot = f"e3-{os.getpid()}-{time.monotonic_ns()}"
    (x, y), yaw = errand.journey.start, float(np.rad2deg(errand.yaw))
    pose, world, seed = f"{x!r},{y!r},{yaw!r}", ("--world", errand.world), ("--seed", str(errand.seed))
    with open_bus(stack.link()) as bus:
        watch = Watch(bus, TRUTH, BELIEF, STATUS, *((PREFERENCE, HEALTH) if errand.told else ()))
        known = ("--initial-pose", pose) if errand.known else ()
        stack.start("controller", *world, *errand.controller, "--belief-timeout", "60")
        stack.start("estimator", *world, *seed, *known, *errand.estimator)
        stack.start(
            "simulator", *world, *seed, "--start", pose, "--beams", str(errand.beams), "--pace", "lockstep",
            "--wait-for", f"estimator,controller,{OURS}", *errand.simulator,
        )  # fmt: skip
        stack.wait_alive(bus)
        given = _give(
            watch, stack, Goal(stamp_ns=0, seq=1, pose=Pose(x=errand.journey.goal[0], y=errand.journey.goal[1]))
        )
        if given.state == "blocked" and not errand.told:
            raise UserError(given.reason)
        bus.declare_alive(OURS)
        track = Track()
        try:
            _follow(watch, stack, errand, track)
        except UserError as error:
            if not errand.told or not track.truths:
                raise
            track.failure = str(error)
    for name in ("controller", "estimator", "simulator"):
        stack.stop(name)
    return track


def _give(watch: Watch, stack: Stack, goal: Goal) -> Status:
    """Until the controller says that it has the goal; sent again, for a message on a new key may be lost."""
    answers: list[Status] = []

    def taken() -> bool:
        stack.check()
        watch.bus.put(GOAL, goal.encode())
        status = watch.until(Status, lambda s: s.goal_seq == goal.seq, 1.0)
        answers.extend([status] if status is not None else [])
        return bool(answers)

    watch.bus.wait_matching(GOAL, 10.0)
    if not wait_until(taken, PATIENCE, 0.0):
        raise UserError(f"the controller did not take the goal within {PATIENCE:g} s")
    return answers[-1]


def _follow(watch: Watch, stack: Stack, errand: Errand, track: Track) -> None:
    """Truths and beliefs of every scan, once each: what is sent again carries a stamp that is known."""
    heard, end = time.monotonic(), None  # ns, the last scan that counts
    while end is None or not track.has(end):
        message, known = watch.next(0.5), len(track.truths) + len(track.beliefs)
        if message is not None:
            _take(message, track, end)
            if end is None and _over(message, track, errand):
                end = message.stamp_ns
        if len(track.truths) + len(track.beliefs) > known:
            heard = time.monotonic()
        elif message is None or isinstance(message, Health):
            stack.check()
            if time.monotonic() - heard > PATIENCE:
                raise UserError(f"no scan was answered within {PATIENCE:g} s, after {len(track.beliefs)} scans")
    track.cut(end)


def _take(message: Stamped, track: Track, end: int | None) -> None:
    """What belongs to the track, up to the end."""
    if isinstance(message, Truth) and end is not None and message.stamp_ns > end:
        return
    if isinstance(message, Truth) and _is_next(track.truths, message):
        track.truths.append(message)
    elif isinstance(message, Belief) and _is_next(track.beliefs, message):
        track.beliefs.append(message)
    elif isinstance(message, Status):
        track.statuses[message.stamp_ns] = message
    elif isinstance(message, Preference):
        track.plans.append(message.stamp_ns)
    elif isinstance(message, Health) and message.service == "controller":
        track.health = message


def _over(message: Stamped, track: Track, errand: Errand) -> bool:
    """Whether nothing after this message counts."""
    if isinstance(message, Truth):
        away = float(np.hypot(*(message.pose.array()[:2] - np.array(errand.journey.goal))))
        return len(track.truths) > errand.limit or (not errand.told and away <= CLOSE)
    if isinstance(message, Status) and errand.told and message.goal_seq:
        return message.state == "reached" or message.refused
    return False


def _is_next(kept: Sequence[Stamped], message: Stamped) -> bool:
    """Whether it is new; raises UserError where one between is missing."""
    if kept and message.stamp_ns <= kept[-1].stamp_ns:
        return False
    period = kept[1].stamp_ns - kept[0].stamp_ns if len(kept) > 1 else None
    if (not kept and message.stamp_ns != 0) or (period and message.stamp_ns - kept[-1].stamp_ns != period):
        raise UserError(f"a message is missing before the {type(message).__name__} of {message.stamp_ns} ns")
    return True
