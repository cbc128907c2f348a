"""Starts a program for each robot of a container, and restarts it when it dies."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import FrameType

from common.processes import end_with_this_process

HELP = """usage: python -m common.containers.run_per_robot each|together|once MODULE [ARGUMENT ...]

Runs `python -m MODULE ARGUMENT ...` for the robots that the environment names: PRESAGE_FLEET=3 are robot-1, robot-2 and
robot-3, or with PRESAGE_ROBOT=truck truck-1, ...; without it, or with 1, there is one, named as PRESAGE_ROBOT says.

  each      a process for each robot, its name in PRESAGE_ROBOT; one that ends is started again
  once      the same, but nothing is started again: ends when all have, with the worst of their statuses
  together  one process for all: PRESAGE_ROBOTS has the names, comma-separated, PRESAGE_ROBOT the first

examples:
  PRESAGE_FLEET=3 python -m common.containers.run_per_robot each services.simulator --beams 622
  PRESAGE_FLEET=3 python -m common.containers.run_per_robot once presage goal 15 1.5 --wait"""
MODES = ("each", "together", "once")
MOST = 100  # robots of one container
FIRST_WAIT, LONGEST_WAIT = 0.5, 10.0  # s before a process is started again, doubled each time
STEADY = 30.0  # s that a process ran, after which the wait is the first again
LOOK = 0.1  # s between two looks at the processes
GRACE = 12.0  # s between asking and killing; compose kills us after 15


def robot_names(environment: Mapping[str, str]) -> list[str]:
    """The robots; raises ValueError where their number is none."""
    base, text = environment.get("PRESAGE_ROBOT") or "robot", environment.get("PRESAGE_FLEET") or "1"
    if not re.fullmatch(r"[0-9]{1,3}", text) or not 1 <= int(text) <= MOST:
        raise ValueError(f"PRESAGE_FLEET={text!r}: how many robots, 1 to {MOST}")
    return [base] if int(text) == 1 else [f"{base}-{number}" for number in range(1, int(text) + 1)]


def main(argv: list[str]) -> int:
    """Run, and the status to end with: 2 where the words make no sense."""
    if not argv or argv[0] in {"-h", "--help"}:
        print(HELP)
        return 0
    mode, *module = argv
    try:
        robots = robot_names(os.environ)
    except ValueError as error:
        return _refuse(str(error))
    if mode not in MODES or not module:
        return _refuse(f"{' '.join(argv)!r}: say each, together or once, and a module; --help has examples")
    command = [sys.executable, "-m", *module]
    if mode == "together" or len(robots) == 1:
        environment = {**os.environ, "PRESAGE_ROBOT": robots[0]}
        if mode == "together" and len(robots) > 1:
            environment["PRESAGE_ROBOTS"] = ",".join(robots)
        os.execve(sys.executable, command, environment)  # noqa: S606 - becomes it: signals and status are its own
    return Fleet(command, robots, again=mode == "each").run()


@dataclass
class Member:
    """A robot's process."""

    robot: str
    child: subprocess.Popen[str] | None = None
    passing: threading.Thread | None = None  # its output on
    began: float = 0.0  # s, monotonic
    wait: float = FIRST_WAIT  # s, before it is started again
    due: float | None = 0.0  # s, monotonic: when it is started; None: no more


class Fleet:
    """One process a robot."""

    def __init__(self, command: list[str], robots: list[str], *, again: bool) -> None:
        """``again``: whether one that ends is started again."""
        self.command, self.again = command, again
        self.members = [Member(robot) for robot in robots]
        self.worst = 0
        self._asked = False  # an Event's wait may hold the lock that its set, in a signal handler, waits for

    def run(self) -> int:
        """Until told to end, or, where nothing is started again, until all have ended; the status."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask)
        try:
            while not self._asked:
                for member in self.members:
                    self._tend(member, time.monotonic())
                if all(member.child is None and member.due is None for member in self.members):
                    break
                time.sleep(LOOK)
        finally:
            self._end()
        return 0 if self._asked else self.worst

    def _ask(self, _signal: int, _frame: FrameType | None) -> None:
        self._asked = True

    def _tend(self, member: Member, now: float) -> None:
        """Start it where that is due; note its end."""
        if member.child is None:
            if member.due is not None and now >= member.due:
                self._start(member, now)
            return
        status = member.child.poll()
        if status is None:
            return
        member.child, member.due = None, None
        self.worst = max(self.worst, status if status >= 0 else 128 - status)
        if not self.again:
            return
        member.wait = FIRST_WAIT if now - member.began > STEADY else min(2 * member.wait, LONGEST_WAIT)
        member.due = now + member.wait
        _say(member.robot, f"ended with status {status}; started again in {member.wait:g} s")

    def _start(self, member: Member, now: float) -> None:
        member.child = subprocess.Popen(  # noqa: S603 - the words we were given
            self.command,
            env={**os.environ, "PRESAGE_ROBOT": member.robot},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,  # a terminal's Ctrl-C is ours to pass on
            preexec_fn=end_with_this_process(),  # noqa: PLW1509 - one call, before any thread of the child
        )
        member.began, member.due = now, None
        member.passing = threading.Thread(target=_pass_on, args=(member.robot, member.child), daemon=True)
        member.passing.start()

    def _end(self) -> None:
        """Ask all, then kill those that do not listen."""
        children = [member.child for member in self.members if member.child is not None]
        for child in children:
            child.terminate()
        deadline = time.monotonic() + GRACE
        for child in children:
            try:
                child.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
        for member in self.members:
            if member.passing is not None:  # their last words; a grandchild may hold the pipe open for ever
                member.passing.join(LOOK)


def _refuse(why: str) -> int:
    print(f"fleet: {why}", file=sys.stderr)
    return 2


def _pass_on(robot: str, child: subprocess.Popen[str]) -> None:
    assert child.stdout is not None  # noqa: S101 - asked for above
    with child.stdout:
        for line in child.stdout:
            _say(robot, line.rstrip())


def _say(robot: str, line: str) -> None:
    print(f"{robot} | {line}", flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
