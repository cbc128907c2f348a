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
from lab.fault_injection.timeline import Row, Timeline, back
from presage.session.ports import free_port
from presage.session.stack import Stack

ROBOT = "chaos"
WORLD = "corridor"
ENDS = ((2.5, 1.5), (15.5, 1.5))  # m, goals in turn
FAST = 0.9  # m/s, of the robot when a fault comes
ROOM = 5.0  # m it still has to go then
PATIENCE = 60.0  # s
WHERE = {"simulator": "robot", "controller": "robot", "observer": "robot", "estimator": "brain"}  # others: here


class System(Stack):
    """All services, three hosts where there is a network, else this one; a context manager."""

    orphan_signal = signal.SIGKILL  # one that is frozen would not end by SIGTERM

    def __init__(
        self,
        folder: Path,
        network: Network | None,
        environment: Mapping[str, str],
        *,
        quiet: bool = True,
        beams: int = 271,
    ) -> None:
        """Recordings and logs go into ``folder``."""
        super().__init__(ROBOT, free_port(), quiet=quiet, environment=environment)
        self.folder, self.network, self.beams = folder, network, beams
        self.timeline = Timeline()
        self.goal = 0  # how many were set
        self.extra: dict[str, dict[str, str]] = {}  # of one process's environment
        self.arguments = {
            "simulator": ["--world", WORLD, "--beams", str(beams)],
            "estimator": ["--world", WORLD],
            "controller": ["--world", WORLD],
            "recorder": ["--directory", str(folder / "recordings")],
            "viewer": ["--port", "0", "--recordings", str(folder / "recordings")],
        }
        if network is not None:
            for name in sorted({*WHERE.values()}):
                network.add(name)

    @property
    def endpoint(self) -> str:
        """The router's, as all hosts see it."""
        return f"tcp/{'127.0.0.1' if self.network is None else self.network.here}:{self.port}"

    def router_endpoints(self) -> str:
        """For the other hosts, too."""
        return self.endpoint if self.network is None else f"tcp/127.0.0.1:{self.port},{self.endpoint}"

    def command(self, name: str, args: list[str]) -> list[str]:
        """On its host."""
        entering = [] if self.network is None or name not in WHERE else self.network.hosts[WHERE[name]].entering
        return [*entering, sys.executable, *args]

    def child_environment(self, name: str) -> Mapping[str, str]:
        """Services listen where the other hosts reach them."""
        more = {"PRESAGE_INSECURE": "1", **self.extra.get(name, {})}
        if self.network is None or name == "router":
            return more
        host = self.network.hosts[WHERE[name]].address if name in WHERE else self.network.here
        return {"PRESAGE_LISTEN": f"tcp/{host}:0", **more}

    def __enter__(self) -> Self:
        self.start_router()
        self.start_python("observer", "from lab.fault_injection.observer import main; main()")
        self._bus = open_bus(self.link())
        self.bus: Bus = self._bus.__enter__()
        for service in self.arguments:
            self.begin(service)
        for service in self.arguments:
            self.timeline.wait(0, back(service), PATIENCE, f"start of the {service}")
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
        """Start a service with its own arguments; one that ended before is forgotten."""
        if service == "router":
            self.start_router()
        else:
            self.start(service, *self.arguments[service])

    def start_module(self, name: str, service: str, *args: str) -> None:
        """One more instance of a service, under a name of its own."""
        self._spawn(name, ["-m", f"services.{service}", *args])

    def signal(self, name: str, number: int) -> None:
        """To a process that still runs."""
        process = self.processes.get(name)
        if process is not None and process.child.poll() is None:
            process.child.send_signal(number)

    def kill(self, *names: str) -> None:
        """Without a word; they are gone when this returns."""
        for name in names:
            self.processes[name].child.kill()
        for name in names:
            self.stop(name)

    def restart(self, *names: str) -> None:
        """Start again what was killed; returns when all say that they are there."""
        since = time.monotonic()
        for name in names:
            self.begin(name)
        for name in names:
            if name != "router":
                self.timeline.wait(since, back(name), PATIENCE, f"return of the {name}")

    # ---- the robot

    def drive(self) -> Row:
        """Until the robot goes fast, with room before it: the row that says so. Goals are its two ends in turn."""
        deadline, since = time.monotonic() + 2 * PATIENCE, time.monotonic()
        while time.monotonic() < deadline:
            status = self._latest("status")
            if status is None or status["state"] in {"idle", "reached"} or self.goal == 0:
                since = time.monotonic()
                self.aim()
            row = self.timeline.wait(since, lambda r: r["what"] == "status", PATIENCE, "a word of the controller")
            since = row["t"] + 1e-6
            distance, speed = row["distance"], self._latest("truth")
            if row["state"] == "navigating" and row["goal_seq"] == self.goal and distance and speed is not None:
                if speed["speed"] >= FAST and distance > ROOM:
                    return speed
                if speed["speed"] >= FAST:
                    self.aim()  # too near: the other end
        raise UserError(f"the robot did not get going: {self._latest('status')}")

    def aim(self) -> None:
        """The end that is farther from where the robot is."""
        here = self._latest("truth")
        x = here["place"][0] if here is not None else 0.0
        goal = max(ENDS, key=lambda end: abs(end[0] - x))
        self.goal += 1
        if not self.bus.wait_matching(GOAL, PATIENCE):
            raise UserError("nobody hears a goal")
        self.bus.put(GOAL, Goal(stamp_ns=0, seq=self.goal, pose=Pose(x=goal[0], y=goal[1])).encode())

    def _latest(self, what: str) -> Row | None:
        return next((row for row in reversed(self.timeline.rows) if row["what"] == what), None)

    def on_output(self, name: str, line: str) -> None:
        """Lines of the observer are what it saw; other lines may tell of a fault."""
        row: Row = {"t": time.monotonic(), "what": "line", "name": name, "line": line}
        if name == "observer":
            with suppress(json.JSONDecodeError):  # zenoh's own lines may come between
                row = json.loads(line)
        self.timeline.add(row)
