"""Starts services as processes and ends them."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from types import FrameType, TracebackType

from typing_extensions import Self

from common.bus.bus import Bus, Link
from common.bus.security import Credentials
from common.errors import UserError
from common.processes import end_with_this_process
from presage.session.ports import accepts, check_port, free_port

COLOURS = {"router": 37, "simulator": 36, "estimator": 35, "controller": 33, "recorder": 32, "viewer": 34}
ACCESS = {"PRESAGE_SECURITY", "PRESAGE_ROLE"}  # meant for us, not for our children
GRACE = 5.0  # s between asking a process to end and ending it
# Who is asked first: the robot stops before its eyes close, and the recorder sees all of it.
ENDING = ("controller", "estimator", "simulator", "viewer", "recorder", "router")


@dataclass
class Process:
    """One child and the thread that passes its lines on."""

    name: str
    child: subprocess.Popen[str]
    reader: threading.Thread
    lines: list[str] = field(default_factory=list)  # the last few, to explain an end
    args: list[str] = field(default_factory=list)  # of Python
    service: str = ""  # the token that says it is there; empty: its name
    robot: str = ""  # whose; empty: the stack's

    def again(self, stack: Stack) -> str:
        """The command that starts another like it, for a shell."""
        said = f"PRESAGE_CONNECT={stack.endpoint} PRESAGE_ROBOT={stack.robot} "
        return ("" if self.name == "router" else said) + shlex.join(["python", *self.args])


def controller_arguments(
    world: str, estimator: Sequence[str], limits: Sequence[str] = ("--drive", "holonomic"), *, lockstep: bool = False
) -> list[str]:
    """Of the controller beside an estimator with these arguments: the paper's two belong together, at one heading."""
    arguments = ["--world", world, *limits]
    if "paper" in estimator:
        arguments += ["--preset", "paper"]
    return [*arguments, *(["--belief-timeout", "20"] if lockstep else [])]


class Stack:
    """Child processes of one session; a context manager that leaves none behind."""

    orphans_get = signal.SIGTERM  # what ends the children where we end without a word

    def __init__(
        self, robot: str, port: int | None = None, *, quiet: bool = False,
        environment: Mapping[str, str] | None = None, security: Credentials | None = None,
    ) -> None:  # fmt: skip
        """``port`` on loopback for the router, or a free one; ``environment`` of the children, or ours.

        With ``security``, ours, the children take theirs from the same folder; else they run without.
        """
        self.security = security
        self.port = port if port is not None else free_port()
        self.robot, self.quiet = robot, quiet
        self.environment = os.environ if environment is None else environment
        self.processes: dict[str, Process] = {}

    @property
    def endpoint(self) -> str:
        """Where the router listens."""
        return f"tcp/127.0.0.1:{self.port}"

    def command(self, name: str, args: list[str]) -> list[str]:  # noqa: ARG002 - for who runs some of them elsewhere
        """What is executed for a child with these arguments of Python."""
        return [sys.executable, *args]

    def variables(self, name: str) -> Mapping[str, str]:  # noqa: ARG002
        """More of a child's environment."""
        return {}

    def router_listens(self) -> str:
        """Endpoints of the router, comma-separated; loopback is among them."""
        return self.endpoint

    def heard(self, name: str, line: str) -> None:
        """A child said something; called from its reader's thread."""

    def link(self) -> Link:
        """For a session of our own beside the children."""
        return Link(robot=self.robot, connect=(self.endpoint,), security=self.security)

    def start_router(self) -> None:
        """The router first; raises UserError where the port is taken."""
        check_port(self.port)
        self._spawn("router", ["-m", "common.router", "--listen", self.router_listens()])
        deadline = time.monotonic() + 20
        while not accepts(self.port):
            self.check()
            if time.monotonic() > deadline:
                raise UserError(f"the router did not listen on {self.endpoint} within 20 s")
            time.sleep(0.02)

    def start(self, service: str, *args: str) -> None:
        """A service, connected to this session's router."""
        self._spawn(service, ["-m", f"services.{service}", *args])

    def start_as(self, name: str, service: str, robot: str, *args: str) -> None:
        """One of several of a kind, under a name of its own, for a robot of its own."""
        self._spawn(name, ["-m", f"services.{service}", "--robot", robot, *args])
        self.processes[name].service, self.processes[name].robot = service, robot

    def start_code(self, name: str, code: str) -> None:
        """A child of our own making that is no service, connected to this session's router."""
        self._spawn(name, ["-c", code])

    def wait_alive(self, bus: Bus, timeout: float = 60.0) -> None:
        """Until every started service has its liveliness token; raises UserError naming who is missing or ended."""
        deadline = time.monotonic() + timeout
        while missing := self._missing(bus):
            self.check()
            if time.monotonic() > deadline:
                raise UserError(f"not alive within {timeout:g} s: {', '.join(sorted(missing))}; their lines are above")
            time.sleep(0.05)

    def _missing(self, bus: Bus) -> set[str]:
        robots = {process.robot or self.robot for process in self.processes.values()}
        alive = {robot: bus.alive(timeout=0.5, robot=robot) for robot in robots}
        return {
            name
            for name, process in self.processes.items()
            if name != "router" and (process.service or name) not in alive[process.robot or self.robot]
        }

    def said(self, name: str, beginning: str, timeout: float = 30.0) -> str:
        """What a child's line says after ``beginning``; raises UserError where it ends, or does not say it in time."""
        deadline = time.monotonic() + timeout
        while True:
            for line in self.processes[name].lines:
                if (text := _text_of(line)).startswith(beginning):
                    return text.removeprefix(beginning)
            self.check()
            if time.monotonic() > deadline:
                raise UserError(f"{name} did not say {beginning!r} within {timeout:g} s; its lines are above")
            time.sleep(0.02)

    def ended(self) -> list[str]:
        """Names of children that are gone."""
        return [name for name, process in self.processes.items() if process.child.poll() is not None]

    def check(self) -> None:
        """Raises UserError with the last line of a child that ended though nobody asked it to."""
        for name in self.ended():
            process = self.processes[name]
            process.reader.join(timeout=1)
            last = process.lines[-1] if process.lines else "without a word"
            raise UserError(f"{name} ended with status {process.child.returncode}: {last}")

    def _spawn(self, name: str, args: list[str]) -> None:
        environment = {
            **{name: value for name, value in self.environment.items() if name not in ACCESS},
            **({} if self.security is None else {"PRESAGE_SECURITY": str(self.security.folder.parent)}),
            "PRESAGE_CONNECT": self.endpoint,
            "PRESAGE_ROBOT": self.robot,
            "PYTHONUNBUFFERED": "1",
            **self.variables(name),
        }
        child = subprocess.Popen(  # noqa: S603 - our own modules
            self.command(name, args),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C is ours to pass on, in order
            preexec_fn=end_with_this_process(self.orphans_get),  # noqa: PLW1509 - one call, before any thread of the child
        )
        process = Process(name, child, threading.Thread(target=lambda: self._pass_on(process), daemon=True))
        process.args = args
        process.reader.start()
        self.processes[name] = process

    def _pass_on(self, process: Process) -> None:
        assert process.child.stdout is not None  # noqa: S101 - asked for above
        colour = f"\033[{COLOURS.get(process.name, 0)}m" if sys.stderr.isatty() else ""
        for line in process.child.stdout:
            process.lines = [*process.lines[-20:], line.rstrip()]
            self.heard(process.name, line.rstrip())
            if self.quiet or process.name == "observer":
                continue
            if line.startswith("{"):  # a log line as JSON says itself whose it is
                print(line.rstrip(), file=sys.stderr)
            else:
                print(
                    f"{colour}{process.name:>10} |{chr(27) + '[0m' if colour else ''} {line.rstrip()}", file=sys.stderr
                )

    def stop(self, name: str) -> int:
        """End one child cleanly; its status."""
        process = self.processes.pop(name)
        return _end(process)

    def close(self) -> None:
        """End all, in order; those that do not listen are killed."""
        for name in sorted(self.processes, key=lambda n: ENDING.index(n) if n in ENDING else -1):
            self.stop(name)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with ignoring_interrupts():
            self.close()


def _text_of(line: str) -> str:
    """What a line says, also one of a log in JSON."""
    with suppress(ValueError, AttributeError):
        return str(json.loads(line).get("event", line))
    return line


def _end(process: Process) -> int:
    """Its status; one that ended already is tidied up."""
    child = process.child
    if child.poll() is None:
        child.terminate()
        try:
            child.wait(GRACE)
        except subprocess.TimeoutExpired:
            print(f"{process.name} did not end within {GRACE:g} s and is killed", file=sys.stderr)
            child.kill()
            child.wait()
    process.reader.join(timeout=1)
    if child.stdout is not None:
        child.stdout.close()
    return child.returncode


@contextmanager
def interruptible() -> Iterator[None]:
    """SIGTERM and SIGHUP, where nohup does not ignore them, end the block as Ctrl-C does: what it started is ended."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    heard = [s for s in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(s) != signal.SIG_IGN]
    before = {s: signal.signal(s, interrupt) for s in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def ignoring_interrupts() -> Iterator[None]:
    """A second Ctrl-C does not cut the cleaning short."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before: dict[int, Callable[[int, FrameType | None], object] | int | None] = {
        s: signal.signal(s, signal.SIG_IGN) for s in numbers
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
