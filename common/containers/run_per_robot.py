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

Runs `python -m MODULE ARGUMENT ...` for each robot. PRESAGE_FLEET is the number of robots: with 3 they are robot-1,
robot-2 and robot-3, or with PRESAGE_ROBOT=truck truck-1, truck-2 and truck-3. If it is 1 or not set, the only robot has
the name PRESAGE_ROBOT.

  each      one process for each robot, with its name in PRESAGE_ROBOT; a process that ends is started again
  once      like each, but no process is started again: ends when all have ended, with the highest of their statuses
  together  one process for all robots: PRESAGE_ROBOTS has their names, comma-separated, PRESAGE_ROBOT the first

examples:
  PRESAGE_FLEET=3 python -m common.containers.run_per_robot each services.simulator --beams 622
  PRESAGE_FLEET=3 python -m common.containers.run_per_robot once presage goal 15 1.5 --wait"""
MODES = ("each", "together", "once")
MAX_ROBOTS = 100  # in one container
MIN_RESTART_DELAY_S, MAX_RESTART_DELAY_S = 0.5, 10.0  # doubled at each restart
STABLE_RUN_S = 30.0  # a process that ran for longer is restarted with the minimum delay
POLL_PERIOD_S = 0.1
STOP_TIMEOUT_S = 12.0  # between SIGTERM and SIGKILL; compose kills this process after 15 s


def robot_names(environment: Mapping[str, str]) -> list[str]:
    """Names of the container's robots; raises ValueError if PRESAGE_FLEET is not a valid number."""
    base, text = environment.get("PRESAGE_ROBOT") or "robot", environment.get("PRESAGE_FLEET") or "1"
    if not re.fullmatch(r"[0-9]{1,3}", text) or not 1 <= int(text) <= MAX_ROBOTS:
        raise ValueError(f"PRESAGE_FLEET={text!r}: expected the number of robots, 1 to {MAX_ROBOTS}")
    return [base] if int(text) == 1 else [f"{base}-{number}" for number in range(1, int(text) + 1)]


def main(argv: list[str]) -> int:
    """Runs the program and returns the exit status, which is 2 for invalid arguments."""
    if not argv or argv[0] in {"-h", "--help"}:
        print(HELP)
        return 0
    mode, *module = argv
    try:
        robots = robot_names(os.environ)
    except ValueError as error:
        return _refuse(str(error))
    if mode not in MODES or not module:
        return _refuse(f"{' '.join(argv)!r}: give each, together or once, and a module; see --help for examples")
    command = [sys.executable, "-m", *module]
    if mode == "together" or len(robots) == 1:
        environment = {**os.environ, "PRESAGE_ROBOT": robots[0]}
        if mode == "together" and len(robots) > 1:
            environment["PRESAGE_ROBOTS"] = ",".join(robots)
        os.execve(sys.executable, command, environment)  # noqa: S606 - replaces this process, so signals reach it
    return ProcessGroup(command, robots, restart=mode == "each").run()


@dataclass
class RobotProcess:
    """The process of one robot. Times are s of the monotonic clock."""

    robot: str
    child: subprocess.Popen[str] | None = None
    output: threading.Thread | None = None  # prints what the child writes
    started: float = 0.0
    restart_delay: float = MIN_RESTART_DELAY_S  # s
    next_start: float | None = 0.0  # None if it is not started again


class ProcessGroup:
    """Runs one process for each robot."""

    def __init__(self, command: list[str], robots: list[str], *, restart: bool) -> None:
        """With ``restart``, a process that ends is started again."""
        self.command, self.restart = command, restart
        self.processes = [RobotProcess(robot) for robot in robots]
        self.worst_status = 0
        # Not a threading.Event: its set() in a signal handler would block while the interrupted wait() holds its lock.
        self._stop_requested = False

    def run(self) -> int:
        """Runs until a signal arrives or, without ``restart``, until all processes have ended; returns the status."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._request_stop)
        try:
            while not self._stop_requested:
                for process in self.processes:
                    self._supervise(process, time.monotonic())
                if all(process.child is None and process.next_start is None for process in self.processes):
                    break
                time.sleep(POLL_PERIOD_S)
        finally:
            self._stop_all()
        return 0 if self._stop_requested else self.worst_status

    def _request_stop(self, _signal: int, _frame: FrameType | None) -> None:
        self._stop_requested = True

    def _supervise(self, process: RobotProcess, now: float) -> None:
        """Starts a process when it is due, and handles its end."""
        if process.child is None:
            if process.next_start is not None and now >= process.next_start:
                self._start(process, now)
            return
        status = process.child.poll()
        if status is None:
            return
        process.child, process.next_start = None, None
        self.worst_status = max(self.worst_status, status if status >= 0 else 128 - status)
        if not self.restart:
            return
        stable = now - process.started > STABLE_RUN_S
        process.restart_delay = MIN_RESTART_DELAY_S if stable else min(2 * process.restart_delay, MAX_RESTART_DELAY_S)
        process.next_start = now + process.restart_delay
        _print_line(process.robot, f"ended with status {status}; started again in {process.restart_delay:g} s")

    def _start(self, process: RobotProcess, now: float) -> None:
        process.child = subprocess.Popen(  # noqa: S603 - the command is this program's own argument
            self.command,
            env={**os.environ, "PRESAGE_ROBOT": process.robot},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,  # this process forwards a terminal's Ctrl-C
            preexec_fn=end_with_this_process(),  # noqa: PLW1509 - one call, before any thread of the child
        )
        process.started, process.next_start = now, None
        process.output = threading.Thread(target=_print_output, args=(process.robot, process.child), daemon=True)
        process.output.start()

    def _stop_all(self) -> None:
        """Terminates all processes, and kills those that do not end in time."""
        children = [process.child for process in self.processes if process.child is not None]
        for child in children:
            child.terminate()
        deadline = time.monotonic() + STOP_TIMEOUT_S
        for child in children:
            try:
                child.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
        for process in self.processes:
            if process.output is not None:  # print the last lines, but a grandchild may keep the pipe open for ever
                process.output.join(POLL_PERIOD_S)


def _refuse(error: str) -> int:
    """Prints an error; returns the exit status for invalid arguments."""
    print(f"fleet: {error}", file=sys.stderr)
    return 2


def _print_output(robot: str, child: subprocess.Popen[str]) -> None:
    assert child.stdout is not None  # noqa: S101 - Popen was called with stdout=PIPE
    with child.stdout:
        for line in child.stdout:
            _print_line(robot, line.rstrip())


def _print_line(robot: str, line: str) -> None:
    print(f"{robot} | {line}", flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
