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
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType

from typing_extensions import Self

from common.bus.bus import Bus, Link
from common.bus.security import Credentials
from common.errors import UserError
from common.processes import end_with_this_process
from presage.interrupts import deferring_interrupts, ignoring_interrupts
from presage.session.ports import accepts_connections, check_port, free_port

COLOURS = {"router": 37, "simulator": 36, "estimator": 35, "mapper": 35, "controller": 33, "recorder": 32, "viewer": 34}
SECURITY_VARIABLES = {"PRESAGE_SECURITY", "PRESAGE_ROLE"}  # choose this process's credentials, not the children's
SLOW_START_S = 4.0  # time without all services after which the user is told which are missing
SECRETS = {"PRESAGE_VIEWER_TOKEN"}  # settings whose values are not shown
ALIVE_TIMEOUT_S = 60.0  # for all services to start; the estimator may have to compile
LINE_TIMEOUT_S = 30.0  # for a line of output
TERMINATION_TIMEOUT_S = 5.0  # between SIGTERM and SIGKILL
# The controller stops the robot first; the recorder ends late, to record how the others stop.
SHUTDOWN_ORDER = ("controller", "estimator", "mapper", "simulator", "viewer", "recorder", "router")


@dataclass
class ServiceProcess:
    """A child process and the thread that reads its output."""

    name: str
    child: subprocess.Popen[str]
    reader: threading.Thread
    lines: list[str] = field(default_factory=list)  # the last few lines of output, for error messages
    args: list[str] = field(default_factory=list)  # arguments of the Python interpreter
    service: str = ""  # service name in its liveliness token; defaults to `name`
    robot: str = ""  # robot it belongs to; defaults to the robot of the stack
    settings: dict[str, str] = field(default_factory=dict)  # environment variables that are settings

    @property
    def restart_command(self) -> str:
        """Shell command that starts the same service again, with ``...`` in place of secrets."""
        variables = [
            f"{name}={'...' if name in SECRETS else shlex.quote(value)}" for name, value in self.settings.items()
        ]
        return " ".join([*variables, shlex.join(["python", *self.args])])


class Stack:
    """The services of one session as child processes; a context manager that ends them all on exit."""

    orphan_signal = signal.SIGTERM  # sent to the children if this process dies

    def __init__(
        self,
        robot: str,
        port: int | None = None,
        *,
        quiet: bool = False,
        environment: Mapping[str, str] | None = None,
        security: Credentials | None = None,
    ) -> None:
        """Does not start any process yet.

        ``port`` is the router's port on loopback; it defaults to a free port. ``environment`` is the children's
        environment; it defaults to that of this process. ``security`` are the credentials of this process; the children
        then use those of their roles from the same folder.
        """
        self.security = security
        self.port = port if port is not None else free_port()
        self.robot, self.quiet = robot, quiet
        self.environment = os.environ if environment is None else environment
        self.processes: dict[str, ServiceProcess] = {}

    @property
    def endpoint(self) -> str:
        """Endpoint to which the children connect."""
        return f"tcp/127.0.0.1:{self.port}"

    def command(self, name: str, args: list[str]) -> list[str]:  # noqa: ARG002 - subclasses may run it on another host
        """Command line of the child ``name``; ``args`` are the arguments of the Python interpreter."""
        return [sys.executable, *args]

    def child_environment(self, name: str) -> Mapping[str, str]:  # noqa: ARG002 - for subclasses
        """Additional environment variables of the child ``name``."""
        return {}

    def router_endpoints(self) -> str:
        """Comma-separated endpoints on which the router listens, among them loopback."""
        return self.endpoint

    def on_output(self, name: str, line: str) -> None:
        """Hook for subclasses: called for each line that the child ``name`` prints, in its reader thread."""

    def shows_output(self, name: str) -> bool:  # noqa: ARG002 - for subclasses
        """Whether the lines that the child ``name`` prints are shown."""
        return not self.quiet

    def link(self) -> Link:
        """Link for a bus session of this process."""
        return Link(robot=self.robot, connect=(self.endpoint,), security=self.security)

    def start_router(self) -> None:
        """Starts the router and waits until it listens; raises UserError if the port is taken."""
        check_port(self.port)
        self._spawn("router", ["-m", "common.router", "--listen", self.router_endpoints()])
        deadline = time.monotonic() + 20
        while not accepts_connections(self.port):
            self.check()
            if time.monotonic() > deadline:
                raise UserError(f"the router did not start to listen on {self.endpoint} within 20 s")
            time.sleep(0.02)

    def start(self, service: str, *args: str) -> None:
        """Starts a service, connected to this session's router."""
        self._spawn(service, ["-m", f"services.{service}", *args])

    def start_instance(self, name: str, service: str, robot: str, *args: str) -> None:
        """Starts one of several instances of a service, as child ``name``, for the robot ``robot``."""
        self._spawn(name, ["-m", f"services.{service}", "--robot", robot, *args])
        self.processes[name].service, self.processes[name].robot = service, robot

    def start_python(self, name: str, code: str) -> None:
        """Starts a child that runs the given Python code, with the environment of a service."""
        self._spawn(name, ["-c", code])

    def wait_alive(self, bus: Bus) -> None:
        """Waits until every started service has its liveliness token.

        Raises UserError with the names of the missing services, or if a service has ended.
        """
        start_s, explained = time.monotonic(), False
        while missing := self._missing(bus):
            self.check()
            passed_s = time.monotonic() - start_s
            if passed_s > SLOW_START_S and not explained:
                explained = True
                names = ", ".join(sorted(missing))
                print(
                    f"waiting for {names}: the first start compiles code, which can take half a minute",
                    file=sys.stderr,
                    flush=True,
                )
            if passed_s > ALIVE_TIMEOUT_S:
                raise UserError(
                    f"not alive within {ALIVE_TIMEOUT_S:g} s: {', '.join(sorted(missing))}; see their log lines above"
                )
            time.sleep(0.05)

    def _missing(self, bus: Bus) -> set[str]:
        robots = {process.robot or self.robot for process in self.processes.values()}
        alive = {robot: bus.alive(timeout=0.5, robot=robot) for robot in robots}
        return {
            name
            for name, process in self.processes.items()
            if name != "router" and (process.service or name) not in alive[process.robot or self.robot]
        }

    def wait_for_line(self, name: str, beginning: str) -> str:
        """Waits for an output line of the child ``name`` that starts with ``beginning``; returns the rest of the line.

        Raises UserError if the line does not come within `LINE_TIMEOUT_S`, or if a child ends.
        """
        deadline = time.monotonic() + LINE_TIMEOUT_S
        while True:
            for line in self.processes[name].lines:
                if (text := _log_text(line)).startswith(beginning):
                    return text.removeprefix(beginning)
            self.check()
            if time.monotonic() > deadline:
                raise UserError(
                    f"{name} did not print {beginning!r} within {LINE_TIMEOUT_S:g} s; see its log lines above"
                )
            time.sleep(0.02)

    def start_commands(self) -> dict[str, str]:
        """Shell commands that start the children again, as `RunningSession` keeps them."""
        return {
            f"{process.robot}/{process.service}" if process.robot else name: process.restart_command
            for name, process in self.processes.items()
        }

    def ended(self) -> list[str]:
        """Names of the children that have ended."""
        return [name for name, process in self.processes.items() if process.child.poll() is not None]

    def check(self) -> None:
        """Raises UserError with the last output line of a child that has ended by itself."""
        for name in self.ended():
            process = self.processes[name]
            process.reader.join(timeout=1)
            last = process.lines[-1] if process.lines else "it printed nothing"
            raise UserError(f"{name} ended with status {process.child.returncode}: {last}")

    def _spawn(self, name: str, args: list[str]) -> None:
        environment = {
            **{name: value for name, value in self.environment.items() if name not in SECURITY_VARIABLES},
            **({} if self.security is None else {"PRESAGE_SECURITY": str(self.security.folder.parent)}),
            "PRESAGE_CONNECT": self.endpoint,
            "PRESAGE_ROBOT": self.robot,
            "PYTHONUNBUFFERED": "1",
            **self.child_environment(name),
        }
        with deferring_interrupts():  # so that a child is known as soon as it runs
            child = subprocess.Popen(  # noqa: S603 - our own modules
                self.command(name, args),
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                start_new_session=True,  # so that Ctrl-C does not reach the children: they are ended in order
                preexec_fn=end_with_this_process(self.orphan_signal),  # noqa: PLW1509 - no threads in the child yet
            )
            process = ServiceProcess(
                name, child, threading.Thread(target=lambda: self._forward_output(process), daemon=True)
            )
            process.args = args
            process.settings = {k: v for k, v in environment.items() if k.startswith("PRESAGE_")}
            process.reader.start()
            self.processes[name] = process

    def _forward_output(self, process: ServiceProcess) -> None:
        """Prints the child's output to standard error, each line with the child's name in front."""
        assert process.child.stdout is not None  # noqa: S101 - it is a pipe, see _spawn
        colour = f"\033[{COLOURS.get(process.name, 0)}m" if sys.stderr.isatty() else ""
        for line in process.child.stdout:
            process.lines = [*process.lines[-20:], line.rstrip()]
            self.on_output(process.name, line.rstrip())
            if not self.shows_output(process.name):
                continue
            if line.startswith("{"):  # a JSON log line contains the name of its service
                print(line.rstrip(), file=sys.stderr)
            else:
                print(
                    f"{colour}{process.name:>10} |{chr(27) + '[0m' if colour else ''} {line.rstrip()}", file=sys.stderr
                )

    def stop(self, name: str) -> int:
        """Ends one child as `close` does; returns its exit status."""
        process = self.processes.pop(name)
        return _end(process)

    def close(self) -> None:
        """Ends all children in `SHUTDOWN_ORDER`, others first; a child that ignores SIGTERM is killed."""
        for name in sorted(self.processes, key=lambda n: SHUTDOWN_ORDER.index(n) if n in SHUTDOWN_ORDER else -1):
            self.stop(name)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with ignoring_interrupts():
            self.close()


def _log_text(line: str) -> str:
    """The message of a log line; also of a JSON log line."""
    with suppress(ValueError, AttributeError):
        return str(json.loads(line).get("event", line))
    return line


def _end(process: ServiceProcess) -> int:
    """Ends the child unless it has ended, and releases its resources; returns its exit status."""
    child = process.child
    if child.poll() is None:
        child.terminate()
        try:
            child.wait(TERMINATION_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            print(f"{process.name} did not end within {TERMINATION_TIMEOUT_S:g} s and is killed", file=sys.stderr)
            child.kill()
            child.wait()
    process.reader.join(timeout=1)
    if child.stdout is not None:
        child.stdout.close()
    return child.returncode
