"""One drive to a goal through the real processes, in lockstep.

All processes but the router are restarted for every drive, so the results depend on the run's parameters alone and
not on earlier runs. In lockstep each scan waits for the command that answers it, so the machine's speed does not
matter either.
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
from common.messages.definitions import Belief, Goal, Health, Pose, Stamped, Status, Truth
from common.messages.topics import BELIEF, GOAL, HEALTH, STATUS, TRUTH
from lab.experiments.start_and_goal import ARRIVAL_DISTANCE, StartAndGoal
from lab.workers import THREAD_COUNT_VARIABLES
from presage.live.latest_messages import LatestMessages
from presage.session.stack import Stack

# This process's liveliness token. The simulator waits for it, so that the goal is set before the first scan.
HARNESS_NAME = "experiment"
TIMEOUT_S = 120.0  # wall time without a message
MAX_ROUTER_STARTS = 5  # another process may take the free port before the router listens on it


@dataclass(frozen=True)
class LockstepRun:
    """Parameters of a run; its results depend on nothing else."""

    ends: StartAndGoal
    yaw: float  # rad, of the robot at the start
    world: str
    beams: int
    seed: int
    estimator: tuple[str, ...]  # command-line arguments of the estimator
    limit: int  # maximum number of scans
    controller: tuple[str, ...] = ("--preset", "paper")  # command-line arguments of the controller
    simulator: tuple[str, ...] = ()  # command-line arguments of the simulator
    sweep: bool = False  # whether motion distorts the scans, as by default in the simulator
    # Whether the run ends when the controller reports that the goal is reached or refused; otherwise it ends when the
    # robot truly is near the goal.
    ends_with_status: bool = False
    goal: Goal | None = None  # defaults to the one of `ends`, at any heading
    scans_after_end: int = 0  # recorded after that, while the robot comes to a stand


@dataclass
class RunTrace:
    """Recorded messages of a run, one truth and one belief per scan; the first are from before any motion."""

    truths: list[Truth] = field(default_factory=list)
    beliefs: list[Belief] = field(default_factory=list)
    statuses: dict[int, Status] = field(default_factory=dict)  # the last status of each stamp (ns)
    plans: list[int] = field(default_factory=list)  # stamps (ns) of new cost fields, if the run records them
    health: Health | None = None  # the controller's last health message
    ended_ns: int | None = None  # stamp at which the run ended, before `scans_after_end`; None if it was aborted
    failure: str = ""  # why the run was aborted; empty if it was not

    def path(self) -> Array:
        """True poses (N, 3)."""
        return np.array([truth.pose.array() for truth in self.truths])

    def believed(self) -> Array:
        """Believed poses (N, 3) at the same scans."""
        return np.array([belief.pose.array() for belief in self.beliefs])

    @property
    def last_status(self) -> Status | None:
        """The controller's last status; None if it sent none."""
        return self.statuses[max(self.statuses)] if self.statuses else None

    @property
    def seconds(self) -> float:
        """Time in s from the first scan until the run ended or was aborted."""
        return (self.truths[-1].stamp_ns if self.ended_ns is None else self.ended_ns) * 1e-9

    def has(self, stamp_ns: int) -> bool:
        """Whether the truth, the belief and the status of that scan have been received."""
        kept_stamps = (
            [each.stamp_ns for each in self.truths],
            [each.stamp_ns for each in self.beliefs],
            list(self.statuses),
        )
        return all(max(stamps, default=-1) >= stamp_ns for stamps in kept_stamps)

    def discard_after(self, stamp_ns: int) -> None:
        """Removes all messages about later scans."""
        self.truths = [each for each in self.truths if each.stamp_ns <= stamp_ns]
        self.beliefs = [each for each in self.beliefs if each.stamp_ns <= stamp_ns]
        self.statuses = {stamp: each for stamp, each in self.statuses.items() if stamp <= stamp_ns}
        self.plans = [stamp for stamp in self.plans if stamp <= stamp_ns]


@contextmanager
def session() -> Iterator[Stack]:
    """Context manager: a router for several runs. On exit it ends all processes."""
    # Without the user's own settings, which would change the experiment. With one thread per process, because
    # floating-point sums depend on how they are split among threads.
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PRESAGE_")}
    environment = clean | dict.fromkeys(THREAD_COUNT_VARIABLES, "1")
    for tries_left in reversed(range(MAX_ROUTER_STARTS)):
        with Stack("lockstep", quiet=True, environment=environment) as stack:
            try:
                stack.start_router()
            except UserError:
                if not tries_left:
                    raise
                continue
            yield stack
            return


def run(params: LockstepRun, stack: Stack) -> RunTrace:
    """Runs the services until the robot is at the goal or ``limit`` scans were answered, then ends the services.

    Raises UserError if a process fails. With ``ends_with_status``, a failure after the first scan is stored in the
    trace's ``failure`` instead.
    """
    # A unique robot name, so that messages of earlier runs or other sessions are not received.
    stack.robot = f"lockstep-{os.getpid()}-{time.monotonic_ns()}"
    (x, y), yaw = params.ends.start, float(np.rad2deg(params.yaw))
    pose, world, seed = f"{x!r},{y!r},{yaw!r}", ("--world", params.world), ("--seed", str(params.seed))
    with open_bus(stack.link()) as bus:
        messages = LatestMessages(bus, TRUTH, BELIEF, STATUS, *((HEALTH,) if params.ends_with_status else ()))
        stack.start("controller", *world, *params.controller, "--belief-timeout", "60")
        stack.start("estimator", *world, *seed, "--initial-pose", pose, *params.estimator)
        stack.start(
            "simulator",
            *world,
            *seed,
            "--start",
            pose,
            "--beams",
            str(params.beams),
            "--sweep" if params.sweep else "--no-sweep",
            "--pace",
            "lockstep",
            "--wait-for",
            f"estimator,controller,{HARNESS_NAME}",
            *params.simulator,
        )
        stack.wait_alive(bus)
        x, y = params.ends.goal
        answer = _send_goal(messages, stack, params.goal or Goal(stamp_ns=0, seq=1, pose=Pose(x=x, y=y)))
        if answer.refused and not params.ends_with_status:
            raise UserError(answer.reason)
        bus.declare_alive(HARNESS_NAME)
        trace = RunTrace()
        try:
            _record(messages, stack, params, trace)
        except UserError as error:
            if not params.ends_with_status or not trace.truths:
                raise
            trace.failure = str(error)
    for name in ("controller", "estimator", "simulator"):
        stack.stop(name)
    return trace


def _send_goal(messages: LatestMessages, stack: Stack, goal: Goal) -> Status:
    """Sends the goal repeatedly until the controller's status confirms it: the first message on a new key may be lost.

    Returns that status.
    """
    answers: list[Status] = []

    def accepted() -> bool:
        stack.check()
        messages.bus.put(GOAL, goal.encode())
        status = messages.wait_for(Status, lambda s: s.goal_seq == goal.seq, 1.0)
        answers.extend([status] if status is not None else [])
        return bool(answers)

    messages.bus.wait_matching(GOAL, 10.0)
    if not wait_until(accepted, TIMEOUT_S, 0.0):
        raise UserError(f"the controller did not confirm the goal within {TIMEOUT_S:g} s")
    return answers[-1]


def _record(messages: LatestMessages, stack: Stack, params: LockstepRun, trace: RunTrace) -> None:
    """Appends messages to the trace until the run ends. Skips repeated messages, which have a known stamp."""
    last_progress, end = time.monotonic(), None  # end: stamp of the last scan, ns
    while end is None or not trace.has(end):
        message, count = messages.next(0.5), len(trace.truths) + len(trace.beliefs)
        if message is not None:
            _append(message, trace, end)
            if end is None and _is_final(message, trace, params):
                trace.ended_ns = message.stamp_ns
                end = message.stamp_ns + params.scans_after_end * _period(trace)
        if len(trace.truths) + len(trace.beliefs) > count:
            last_progress = time.monotonic()
        elif message is None or isinstance(message, Health):
            stack.check()
            if time.monotonic() - last_progress > TIMEOUT_S:
                raise UserError(f"no scan was answered within {TIMEOUT_S:g} s, after {len(trace.beliefs)} scans")
    trace.discard_after(end)


def _append(message: Stamped, trace: RunTrace, end: int | None) -> None:
    """Stores the message in the trace, unless it is about a scan after ``end`` (ns)."""
    if isinstance(message, Truth) and end is not None and message.stamp_ns > end:
        return
    if isinstance(message, Truth) and _is_next(trace.truths, message):
        trace.truths.append(message)
    elif isinstance(message, Belief) and _is_next(trace.beliefs, message):
        trace.beliefs.append(message)
    elif isinstance(message, Status):
        trace.statuses[message.stamp_ns] = message
    elif isinstance(message, Health) and message.service == "controller":
        trace.health = message


def _is_final(message: Stamped, trace: RunTrace, params: LockstepRun) -> bool:
    """Whether this message is about the last scan of the run."""
    if isinstance(message, Truth):
        away = float(np.hypot(*(message.pose.array()[:2] - np.array(params.ends.goal))))
        return len(trace.truths) > params.limit or (not params.ends_with_status and away <= ARRIVAL_DISTANCE)
    if isinstance(message, Status) and params.ends_with_status and message.goal_seq:
        return message.state == "reached" or message.refused
    return False


def _period(trace: RunTrace) -> int:
    """Time between scans in ns; 0 before the second scan."""
    return trace.truths[1].stamp_ns - trace.truths[0].stamp_ns if len(trace.truths) > 1 else 0


def _is_next(kept: Sequence[Stamped], message: Stamped) -> bool:
    """Whether the message follows the last one kept; False if it repeats it. Raises UserError if one is missing."""
    if kept and message.stamp_ns <= kept[-1].stamp_ns:
        return False
    period = kept[1].stamp_ns - kept[0].stamp_ns if len(kept) > 1 else None
    if (not kept and message.stamp_ns != 0) or (period and message.stamp_ns - kept[-1].stamp_ns != period):
        raise UserError(f"a message is missing before the {type(message).__name__} of {message.stamp_ns} ns")
    return True
