"""The system under test: every service on its own host."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from typing_extensions import Self

from common.bus.bus import Bus, open_bus
from common.errors import UserError
from common.messages.definitions import Goal, Pose
from common.messages.topics import GOAL
from lab.fault_injection.hosts import Network
from lab.fault_injection.timeline import Row, Timeline, is_back
from presage.session.ports import free_port
from presage.session.stack import Stack

ROBOT = "chaos"
WORLD = "corridor"
GOALS = ((2.5, 1.5), (15.5, 1.5))  # m; the robot drives back and forth between them
FAULT_SPEED = 0.9  # m/s, minimum speed when a fault is injected
MIN_DISTANCE_TO_GOAL = 5.0  # m, when a fault is injected
TIMEOUT_S = 60.0
# Host of each process; the others run in this process's namespace.
HOST_OF = {"simulator": "robot", "controller": "robot", "observer": "robot", "estimator": "brain"}


class System(Stack):
    """All services, on three hosts if a network is given, otherwise on one; a context manager."""

    orphan_signal = signal.SIGKILL  # a frozen process ignores SIGTERM

    def __init__(
        self,
        folder: Path,
        network: Network | None,
        environment: Mapping[str, str],
        *,
        quiet: bool = True,
        beams: int = 271,
    ) -> None:
        """Recordings and logs are written into ``folder``."""
        super().__init__(ROBOT, free_port(), quiet=quiet, environment=environment)
        self.folder, self.network = folder, network
        self.timeline = Timeline()
        self.goal = 0  # number of goals sent so far
        self.extra: dict[str, dict[str, str]] = {}  # additional environment variables by process
        self.arguments = {
            "simulator": ["--world", WORLD, "--beams", str(beams)],
            "estimator": ["--world", WORLD],
            "controller": ["--world", WORLD],
            "recorder": ["--directory", str(folder / "recordings")],
            "viewer": ["--port", "0", "--recordings", str(folder / "recordings")],
        }
        if network is not None:
            for name in sorted({*HOST_OF.values()}):
                network.add(name)

    @property
    def endpoint(self) -> str:
        """The router's endpoint, as seen from all hosts."""
        return f"tcp/{'127.0.0.1' if self.network is None else self.network.own_address}:{self.port}"

    def router_endpoints(self) -> str:
        """Endpoints on which the router listens: loopback, and the address for the other hosts."""
        return self.endpoint if self.network is None else f"tcp/127.0.0.1:{self.port},{self.endpoint}"

    def command(self, name: str, args: list[str]) -> list[str]:
        """The command line that starts a process on its host."""
        if self.network is None or name not in HOST_OF:
            return [sys.executable, *args]
        return [*self.network.hosts[HOST_OF[name]].command_prefix, sys.executable, *args]

    def child_environment(self, name: str) -> Mapping[str, str]:
        """Environment variables of a process; with several hosts it listens on its host's address."""
        more = {"PRESAGE_INSECURE": "1", "PRESAGE_LOG_JSON": "true", **self.extra.get(name, {})}
        if self.network is None or name == "router":
            return more
        host = self.network.hosts[HOST_OF[name]].address if name in HOST_OF else self.network.own_address
        return {"PRESAGE_LISTEN": f"tcp/{host}:0", **more}

    def __enter__(self) -> Self:
        self.start_router()
        self.start_python("observer", "from lab.fault_injection.observer import main; main()")
        self._bus = open_bus(self.link())
        self.bus: Bus = self._bus.__enter__()
        for service in self.arguments:
            self.begin(service)
        for service in self.arguments:
            self.timeline.wait(0, is_back(service), TIMEOUT_S, f"start of the {service}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name in list(self.processes):
            self.signal(name, signal.SIGCONT)
        self._bus.__exit__(kind, error, trace)
        super().__exit__(kind, error, trace)

    # ---- processes

    def begin(self, service: str) -> None:
        """Starts a service with its arguments."""
        if service == "router":
            self.start_router()
        else:
            self.start(service, *self.arguments[service])

    def start_module(self, name: str, service: str, *args: str) -> None:
        """Starts one more instance of a service under another name."""
        self._spawn(name, ["-m", f"services.{service}", *args])

    def signal(self, name: str, number: int) -> None:
        """Sends a signal to a process if it still runs."""
        process = self.processes.get(name)
        if process is not None and process.child.poll() is None:
            process.child.send_signal(number)

    def kill(self, *names: str) -> None:
        """Kills processes with SIGKILL and waits until they have ended."""
        for name in names:
            self.processes[name].child.kill()
        for name in names:
            self.stop(name)

    def restart(self, *names: str) -> None:
        """Restarts killed services and waits until their liveliness tokens appear."""
        since = time.monotonic()
        for name in names:
            self.begin(name)
        for name in names:
            if name != "router":
                self.timeline.wait(since, is_back(name), TIMEOUT_S, f"return of the {name}")

    # ---- the robot

    def drive_fast(self) -> Row:
        """Drives until the robot is fast and far from its goal. Returns the event that shows it.

        Raises UserError if that does not happen in time.
        """
        deadline, since = time.monotonic() + 2 * TIMEOUT_S, time.monotonic()
        while time.monotonic() < deadline:
            status = self._latest("status")
            if status is None or status["state"] in {"idle", "reached"} or self.goal == 0:
                since = time.monotonic()
                self.set_far_goal()
            row = self.timeline.wait(since, lambda r: r["what"] == "status", TIMEOUT_S, "a status of the controller")
            since = row["t"] + 1e-6
            distance, speed = row["distance"], self._latest("truth")
            if row["state"] == "navigating" and row["goal_seq"] == self.goal and distance and speed is not None:
                if speed["speed"] >= FAULT_SPEED and distance > MIN_DISTANCE_TO_GOAL:
                    return speed
                if speed["speed"] >= FAULT_SPEED:
                    self.set_far_goal()  # too close to the goal: turn around
        raise UserError(f"the robot did not reach {FAULT_SPEED:g} m/s; the last status: {self._latest('status')}")

    def set_far_goal(self) -> None:
        """Sends the goal that is farther from the robot."""
        here = self._latest("truth")
        x = here["place"][0] if here is not None else 0.0
        goal = max(GOALS, key=lambda end: abs(end[0] - x))
        self.goal += 1
        if not self.bus.wait_matching(GOAL, TIMEOUT_S):
            raise UserError(f"no controller subscribed to goals within {TIMEOUT_S:g} s")
        self.bus.put(GOAL, Goal(stamp_ns=0, seq=self.goal, pose=Pose(x=goal[0], y=goal[1])).encode())

    def _latest(self, what: str) -> Row | None:
        return next((row for row in reversed(self.timeline.rows) if row["what"] == what), None)

    def shows_output(self, name: str) -> bool:
        """Shows no lines of the observer: they are events for the timeline."""
        return name != "observer" and super().shows_output(name)

    def on_output(self, name: str, line: str) -> None:
        """Adds a line to the timeline: one of the observer as it is, a log line of another process with its fields."""
        now, fields = time.monotonic(), None
        with suppress(json.JSONDecodeError):  # zenoh may print lines of its own
            fields = json.loads(line)
        if isinstance(fields, dict):
            self.timeline.add(
                fields if name == "observer" else {"t": now, "what": "log", "name": name, "fields": fields}
            )
