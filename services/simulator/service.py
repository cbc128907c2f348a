"""The process: pace, topics and requests around Simulation."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import ClassVar

import numpy as np

from common.errors import UserError
from common.geometry.world import load_world
from common.messages.definitions import CmdVel, Stamped
from common.messages.requests import (
    ObstacleRequest,
    PoseRequest,
    Reply,
    Request,
    ResetRequest,
    SampleReply,
    SampleRequest,
    SpeedRequest,
    WorldReply,
)
from common.messages.topics import (
    CMD_VEL,
    GOAL,
    OBSTACLE,
    ODOM,
    PAUSE,
    RESET,
    RESUME,
    SAMPLE,
    SCAN,
    SPEED,
    STATUS,
    STEP,
    TELEPORT,
    TRUTH,
    WORLD,
    Query,
    Topic,
)
from common.runtime.service import Service
from services.simulator.odometry import Drift
from services.simulator.settings import SimulatorSettings
from services.simulator.simulation import Setup, Simulation

MAX_SAMPLE = 4_000_000  # ranges an answer, 16 MB
LATE = 1.0  # s behind real time, beyond which it is not caught up


class SimulatorService(Service):
    """The world as a process."""

    name: ClassVar[str] = "simulator"
    single: ClassVar[bool] = True
    serves_latched: ClassVar[tuple[Topic, ...]] = (GOAL, STATUS)
    inputs: ClassVar[tuple[Topic, ...]] = (CMD_VEL,)
    queries: ClassVar[tuple[Query, ...]] = (TELEPORT, RESET, PAUSE, RESUME, STEP, SPEED, OBSTACLE, SAMPLE, WORLD)

    def __init__(self, settings: SimulatorSettings) -> None:
        """The world is built in `open`."""
        super().__init__(settings)
        self.options = settings
        self.paused = False
        self.speed = 1.0  # simulated time over wall time, in pace realtime
        self._sent: tuple[Stamped, Stamped, Stamped] | None = None  # the observation of now, once published
        self._next = 0.0  # wall time of the next step, or in lockstep of the next complaint
        self._alive: set[str] = set()
        self._wait_for = settings.waited_for()

    @property
    def lockstep(self) -> bool:
        """Whether each scan waits for its command."""
        return self.options.pace == "lockstep"

    @property
    def _period(self) -> float:
        """S of wall time between scans."""
        return self.simulation.period_ns * 1e-9 / self.speed

    def open(self) -> None:
        """Build world and robot; begin once those waited for are there."""
        options = self.options
        drift = Drift(options.turn_by_turn, options.turn_by_path, options.path_by_path, options.path_by_turn)
        robot = options.build_robot()
        self.log.info("loading the world", world=options.world)
        scanner = options.the_scanner()
        self.setup = Setup(
            load_world(options.world), scanner, robot, options.start_pose(), options.seed, drift,
            options.obstacle_stop, options.people, options.people_speed,
        )  # fmt: skip
        self._begin()
        if not options.obstacle_stop:
            self.log.warning("the obstacle stop is off, for fault injection: nothing keeps the robot from contact")
        self._next = time.monotonic()
        if self._wait_for:
            self._say_how_time_goes()
            self.log.info(self.note)
            self.loop.bus.watch_alive(self._changed)

    def _begin(self) -> None:
        self.simulation = Simulation(self.setup)
        self._set_hurry()

    def _set_hurry(self) -> None:
        """As fast as it goes: as long as a command is obeyed at all."""
        robot = self.setup.robot
        fast = robot.command_age / robot.command_timeout
        self.simulation.hurry = fast if self.options.pace == "fast" else max(1.0, self.speed)

    def _changed(self, service: str, there: bool) -> None:  # noqa: FBT001 - zenoh's thread; the set alone is shared
        if there:
            self._alive.add(service)
        else:
            self._alive.discard(service)

    def close(self) -> None:
        """Give the physics back."""
        self.simulation.close()

    def due(self) -> float | None:
        """Until the next step, or in lockstep until the scan is sent again."""
        if self.paused:
            return None
        if self._wait_for:
            return 0.0 if self._wait_for <= self._alive else 0.05
        return 0.0 if self.options.pace == "fast" else self._next - time.monotonic()

    def on_timer(self) -> None:
        """Step, by the pace asked for."""
        if self._wait_for:
            self._wait_for = set()
            self._say_how_time_goes()
            self._next = time.monotonic()
        if self._sent is None:
            self._observe()
        elif self.lockstep:
            stamp, wait = self.simulation.stamp_ns, self.options.lockstep_deadline
            self.log.warning(
                "lockstep: no command answered the scan, it is sent again; are estimator and controller running?",
                stamp_ns=stamp, waited_s=wait,
            )  # fmt: skip
            self.counters["scans_sent_again"] += 1
            self._publish()
        else:
            self.simulation.advance()
            self._observe()

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """A command; in lockstep the one that answers the scan of now lets time go on."""
        if not isinstance(message, CmdVel):
            return
        if self.lockstep and message.stamp_ns != self.simulation.stamp_ns:
            self.counters["stale_commands"] += 1
            return
        if self.paused and self.simulation.answered:  # a controller that waits in vain lets the robot stand: not now
            self.counters["stale_commands"] += 1
            return
        if not self.simulation.command(message.stamp_ns, message.twist):
            self.counters["stale_commands"] += 1
            return
        if self.lockstep and not self.paused and self._sent is not None:
            self.simulation.advance()
            self._observe()

    def _observe(self) -> None:
        self._sent = self.simulation.observe()
        self._publish()

    def _publish(self) -> None:
        """Truth and odometry first: who acts on the scan finds them there."""
        assert self._sent is not None  # noqa: S101 - just set
        for topic, message in zip((ODOM, TRUTH, SCAN), self._sent, strict=True):
            self.publish(topic, message)
        now = time.monotonic()
        if self.lockstep:
            self._next = now + self.options.lockstep_deadline
        else:
            self._next += self._period
            if now - self._next > LATE:
                self.counters["late"] += 1
                self._next = now

    def on_request(self, query: Query, request: Request) -> Reply:
        """Do what is asked, or say why not."""
        if query is WORLD:
            simulation = self.simulation
            return WorldReply(world=simulation.world, scanner=self.setup.scanner, robot=self.setup.robot)
        if isinstance(request, SampleRequest):
            return self._sample(request)
        if query is STEP:
            return self._step()
        if isinstance(request, SpeedRequest):
            return self._set_speed(request.factor)
        if isinstance(request, PoseRequest):
            self.simulation.teleport(request.pose.array())
        elif isinstance(request, ObstacleRequest):
            self.simulation.change(request.action, request.name, request.obstacle)
        elif isinstance(request, ResetRequest):
            self._reset(request.seed)
        elif query is PAUSE or query is RESUME:
            self._pause(paused=query is PAUSE)
        else:
            return super().on_request(query, request)
        self.log.info(query.name, request=str(request))
        return Reply()

    def _pause(self, *, paused: bool) -> None:
        self.paused = paused
        self._say_how_time_goes()
        # In lockstep the answer may have come during the pause: the scan is sent again at once.
        self._next = time.monotonic()

    def _say_how_time_goes(self) -> None:
        """The note in health."""
        waits = f"waits for {', '.join(sorted(self._wait_for))}" if self._wait_for else ""
        speed = f"runs at {self.speed:g} x real time" if self.speed != 1 else ""
        self.note = "paused" if self.paused else waits or speed

    def _step(self) -> Reply:
        """While paused, one scan further; in lockstep, as ever, not before the scan of now has its command."""
        if not self.paused:
            return Reply(ok=False, reason="time runs: pause first, then step")
        if self._wait_for:
            return Reply(ok=False, reason=f"time has not begun: waits for {', '.join(sorted(self._wait_for))}")
        self._next = time.monotonic()
        if self._sent is not None and self.lockstep and not self.simulation.answered:
            self._publish()
            return Reply(ok=False, reason="no command has answered this scan yet; it is sent again: ask once more")
        if self._sent is not None:
            self.simulation.advance()
        self._observe()
        return Reply()

    def _set_speed(self, factor: float) -> Reply:
        """Times real time, from now on."""
        if self.options.pace != "realtime":
            why = "each scan waits for its command" if self.lockstep else "it goes as fast as it can"
            return Reply(ok=False, reason=f"the pace is {self.options.pace}: {why}; a speed needs --pace realtime")
        self.speed = factor
        self._set_hurry()
        self._next = min(self._next, time.monotonic() + self._period)  # the next scan may have been far off
        self._say_how_time_goes()
        self.log.info("speed", factor=factor)
        return Reply()

    def _reset(self, seed: int | None) -> None:
        self.setup = replace(self.setup, seed=self.setup.seed if seed is None else seed)
        self.simulation.close()
        self._begin()
        self._sent, self._next = None, time.monotonic()

    def _sample(self, request: SampleRequest) -> SampleReply:
        scanner = self.setup.scanner.with_beams(request.beams)
        if len(request.poses) * scanner.beams > MAX_SAMPLE:
            raise UserError(
                f"{len(request.poses)} poses x {scanner.beams} beams are more than {MAX_SAMPLE}: ask in parts"
            )
        ranges = self.simulation.sample(request.poses, request.beams, request.seed if request.noise else None)
        return SampleReply(scanner=scanner, ranges=np.asarray(ranges, np.float32).ravel())
