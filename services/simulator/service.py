"""The simulator service: commands in; scans, odometry and truth out, at the chosen pace."""

from __future__ import annotations

import time
from concurrent.futures import Future
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
from services.simulator.physics import choose_engine
from services.simulator.settings import SimulatorSettings
from services.simulator.simulation import Simulation, SimulationSetup

MAX_SAMPLE_RANGES = 4_000_000  # in one reply, 16 MB
REPEAT_S = 0.2  # in slow motion, after which a scan is sent again: less than the controller's belief timeout
MAX_LAG_S = 1.0  # a simulation that is farther behind real time goes on from there, without catching up


class SimulatorService(Service):
    """Runs a `Simulation` on the bus: publishes its measurements at the chosen pace, and answers requests.

    A scan is published, then time stands still until the next step. When that comes depends on the setting `pace`: at
    the time of the next scan (realtime), at once (fast), or when a command with the scan's stamp arrives (lockstep).
    """

    name: ClassVar[str] = "simulator"
    single: ClassVar[bool] = True
    serves_latched: ClassVar[tuple[Topic, ...]] = (GOAL, STATUS)
    inputs: ClassVar[tuple[Topic, ...]] = (CMD_VEL,)
    queries: ClassVar[tuple[Query, ...]] = (TELEPORT, RESET, PAUSE, RESUME, STEP, SPEED, OBSTACLE, SAMPLE, WORLD)

    settings: SimulatorSettings

    def __init__(self, settings: SimulatorSettings) -> None:
        super().__init__(settings)
        self.paused = False
        self.speed = 1.0  # simulated time over wall time, in pace realtime
        # The measurements at the present simulated time; None before the first ones, and after a reset.
        self._published: tuple[Stamped, Stamped, Stamped] | None = None
        self._next_step_s = 0.0  # time.monotonic() of the next step; in lockstep, of publishing the same scan again
        self._repeat_s = 0.0  # time.monotonic() at which, in slow motion, the present scan is sent again
        self._alive: set[str] = set()  # services, updated from zenoh's thread
        self._required_services = settings.required_services()  # emptied when time begins

    @property
    def lockstep(self) -> bool:
        """Whether time advances only when a command answers the scan."""
        return self.settings.pace == "lockstep"

    @property
    def _period_s(self) -> float:
        """Wall time between scans."""
        return self.simulation.period_ns * 1e-9 / self.speed

    def open(self) -> None:
        """Builds the world and the robot. Time begins when the required services are running."""
        settings = self.settings
        robot = settings.build_robot()
        self.log.info("loading the world", world=settings.world)
        scanner = settings.build_scanner()
        engine = choose_engine(settings.physics)
        if settings.physics == "auto" and engine == "kinematic":
            self.log.warning("pybullet is not installed: the simulation is kinematic, contacts just stop the robot")
        setup = SimulationSetup(
            world=load_world(settings.world),
            scanner=scanner,
            robot=robot,
            start=settings.start_pose(),
            seed=settings.seed,
            slip=settings.slip,
            sweep=settings.sweep,
            obstacle_stop=settings.obstacle_stop,
            people=settings.people,
            people_speed=settings.people_speed,
            engine=engine,
        )
        self._use(setup, Simulation(setup))
        if not settings.obstacle_stop:
            self.log.warning("the obstacle stop is off, for fault injection: the robot will not brake before obstacles")
        self._next_step_s = time.monotonic()
        if self._required_services:
            self._update_note()
            self.log.info(self.note)
            self.loop.bus.watch_alive(self._on_liveliness)

    def _use(self, setup: SimulationSetup, simulation: Simulation) -> None:
        self.setup, self.simulation = setup, simulation
        self._update_command_timeout()

    def _update_command_timeout(self) -> None:
        """Makes the command timeout longer if simulated time runs faster than the controller's clock.

        At pace fast, the timeout is as long as the age up to which commands are accepted.
        """
        robot = self.setup.robot
        longer = robot.command_timeout * max(1.0, self.speed)
        self.simulation.command_timeout_s = robot.command_age if self.settings.pace == "fast" else longer

    def _on_liveliness(self, service: str, alive: bool) -> None:  # noqa: FBT001 - zenoh calls it, in its own thread
        if alive:
            self._alive.add(service)
        else:
            self._alive.discard(service)

    def close(self) -> None:
        """Ends the simulation."""
        self.simulation.close()

    def due(self) -> float | None:
        """Seconds until the next step; in lockstep, until the scan is published again."""
        if self.paused:
            return None
        if self._required_services:
            return 0.0 if self._required_services <= self._alive else 0.05
        if self.settings.pace == "fast":
            return 0.0
        next_s = min(self._next_step_s, self._repeat_s) if self._is_slow else self._next_step_s
        return next_s - time.monotonic()

    @property
    def _is_slow(self) -> bool:
        """Whether a scan is sent again until the next one, so that slow motion does not look like a failure."""
        return self.speed < 1 and self._published is not None

    def on_timer(self) -> None:
        """Publishes the first scan, or the next one; in lockstep, and in slow motion, the same scan again."""
        if self._required_services:
            self._required_services = set()
            self._update_note()
            self._next_step_s = time.monotonic()
        if self._published is None:
            self._observe()
        elif self.lockstep:
            self.log.warning(
                "lockstep: no command answered the scan, so it is sent again; are estimator and controller running?",
                stamp_ns=self.simulation.stamp_ns,
                waited_s=self.settings.lockstep_deadline,
            )
            self.counters["scans_sent_again"] += 1
            self._publish()
        elif self._is_slow and time.monotonic() < self._next_step_s:
            self._send()
        else:
            self.simulation.advance()
            self._observe()

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """Stores a command. In lockstep, time advances if it answers the present scan."""
        if not isinstance(message, CmdVel):
            return
        if self.lockstep and message.stamp_ns != self.simulation.stamp_ns:
            self.counters["stale_commands"] += 1
            return
        if self.paused and self.simulation.answered:
            # While paused, the controller gets no beliefs and commands a stop. It must not replace the last command.
            self.counters["stale_commands"] += 1
            return
        if not self.simulation.command(message.stamp_ns, message.twist):
            self.counters["stale_commands"] += 1
            return
        if self.lockstep and not self.paused and self._published is not None:
            self.simulation.advance()
            self._observe()

    def _observe(self) -> None:
        self._published = self.simulation.observe()
        self._publish()

    def _publish(self) -> None:
        """Publishes the present scan, and sets the time of the next step."""
        self._send()
        now = time.monotonic()
        if self.lockstep:
            self._next_step_s = now + self.settings.lockstep_deadline
        else:
            self._next_step_s += self._period_s
            if now - self._next_step_s > MAX_LAG_S:
                self.counters["late"] += 1
                self._next_step_s = now

    def _send(self) -> None:
        """Sends odometry and truth before the scan, so that services have them when the scan arrives."""
        assert self._published is not None  # noqa: S101 - set by all callers
        for topic, message in zip((ODOM, TRUTH, SCAN), self._published, strict=True):
            self.publish(topic, message)
        self._repeat_s = time.monotonic() + REPEAT_S

    def on_request(self, query: Query, request: Request) -> Reply | Future[Reply]:
        """Carries out a request. Raises UserError if that is not possible."""
        if query is WORLD:
            simulation = self.simulation
            world = None if self.settings.hide_world else simulation.world
            return WorldReply(world=world, scanner=self.setup.scanner, robot=self.setup.robot)
        if isinstance(request, SampleRequest):
            return self._sample(request)
        if query is STEP:
            return self._step()
        if isinstance(request, SpeedRequest):
            return self._set_speed(request.factor)
        if isinstance(request, PoseRequest):
            self.simulation.teleport(self.simulation.world.to_map(request.pose.array(), request.map_id))
        elif isinstance(request, ObstacleRequest):
            self.simulation.change_obstacle(request.action, request.name, request.obstacle)
        elif isinstance(request, ResetRequest):
            self._reset(request.seed)
        elif query is PAUSE or query is RESUME:
            self._pause(paused=query is PAUSE)
        else:
            return super().on_request(query, request)
        self.log.info(query.name, request=str(request))
        return Reply()

    def _pause(self, *, paused: bool) -> None:
        if paused == self.paused:
            return
        self.paused = paused
        self._update_note()
        self._next_step_s = time.monotonic()
        if self.lockstep and self._published is not None and not paused:
            self._publish()  # again, because a command that came during the pause did not advance time

    def _update_note(self) -> None:
        """Sets the note shown in health: whether and how fast time runs."""
        waits = f"waits for {', '.join(sorted(self._required_services))}" if self._required_services else ""
        speed = f"runs at {self.speed:g} x real time" if self.speed != 1 else ""
        self.note = "paused" if self.paused else waits or speed
        self.idle = self.paused or bool(waits)

    def _step(self) -> Reply:
        """Advances by one scan while paused. In lockstep, the present scan must have been answered by a command."""
        if not self.paused:
            return Reply(ok=False, reason="time runs: pause first, then step")
        if self._required_services:
            return Reply(ok=False, reason=f"time has not begun: waits for {', '.join(sorted(self._required_services))}")
        self._next_step_s = time.monotonic()
        if self._published is not None and self.lockstep and not self.simulation.answered:
            self._publish()
            return Reply(ok=False, reason="no command has answered this scan yet; it is sent again: ask once more")
        if self._published is not None:
            self.simulation.advance()
        self._observe()
        return Reply()

    def _set_speed(self, factor: float) -> Reply:
        """Sets the speed relative to real time."""
        if self.settings.pace != "realtime":
            reason = "each scan waits for its command" if self.lockstep else "it goes as fast as it can"
            return Reply(ok=False, reason=f"the pace is {self.settings.pace}: {reason}; a speed needs --pace realtime")
        self.speed = factor
        self._update_command_timeout()
        # At a low speed, the next step may be far ahead.
        self._next_step_s = min(self._next_step_s, time.monotonic() + self._period_s)
        self._update_note()
        self.log.info("speed", factor=factor)
        return Reply()

    def _reset(self, seed: int | None) -> None:
        setup = replace(self.setup, seed=self.setup.seed if seed is None else seed)
        simulation = Simulation(setup)  # fails if there is no room for the people: then the present one goes on
        self.simulation.close()
        self._use(setup, simulation)
        self._published, self._next_step_s = None, time.monotonic()

    def _sample(self, request: SampleRequest) -> SampleReply:
        scanner = self.setup.scanner.with_beams(request.beams)
        if len(request.poses) * scanner.beams > MAX_SAMPLE_RANGES:
            raise UserError(
                f"{len(request.poses)} poses x {scanner.beams} beams are more than {MAX_SAMPLE_RANGES}: ask in parts"
            )
        ranges = self.simulation.sample(request.poses, request.beams, request.seed if request.noise else None)
        return SampleReply(scanner=scanner, ranges=np.asarray(ranges, np.float32).ravel())
