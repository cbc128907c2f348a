"""Scans of many robots for `bench fleet`."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from common.bus.bus import Bus
from common.bus.inbox import Inbox, Sample
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import Belief, Scan
from common.messages.requests import LocaliseRequest
from common.messages.topics import BELIEF, HEALTH, LOCALISE, PREDICTION, SCAN
from common.messages.wire import DecodeError
from common.robot.scanner import SCANNERS, Scanner

HEADING = np.pi / 2  # rad, constant: preset paper is trained for this heading only
SPEED, RADIUS = 0.3, 0.25  # m/s, m; of the circles that the robots drive
CLEARANCE = 0.5  # m between a circle's centre and the walls
ANSWER_TIMEOUT_S = 1.0  # wait for answers after the last scan


@dataclass
class CirclingRobot:
    """A robot that drives in circles. Its time advances only while its scans are sent."""

    name: str
    centre: Array  # (2,) m
    phase: float  # when its scans are sent, as a share of the scan period
    scans: int = 0  # sent so far

    def pose(self, k: int, rate: float) -> Array:
        """Pose (3,) at its k-th scan."""
        turn = SPEED / RADIUS * k / rate
        return np.array([*(self.centre + RADIUS * np.array([np.cos(turn), np.sin(turn)])), HEADING])


@dataclass(frozen=True)
class AnswerStatistics:
    """Answers to the scans of one measurement."""

    robots: int
    sent: int
    answered: int
    in_time: int
    latency_ms: Array  # (answered,)
    tracking: int  # robots whose last belief has state `tracking`

    @property
    def in_time_share(self) -> float:
        """Share of the scans that were answered within a scan period."""
        return self.in_time / max(1, self.sent)

    def percentile(self, q: float) -> float | None:
        """Percentile of the latency in ms. Returns None if nothing was answered."""
        return float(np.percentile(self.latency_ms, q)) if len(self.latency_ms) else None


class FleetLoad:
    """Simulated robots. Their scans are computed before they are sent, so that sending takes little processor time."""

    def __init__(self, bus: Bus, world: World, beams: int, rate: float, count: int, seed: int) -> None:
        """Places ``count`` robots at random in the world; each sends scans at ``rate`` Hz."""
        self.world, self.rate = world, rate
        self.scanner: Scanner = SCANNERS["tim571"].with_beams(beams)
        self._rng = np.random.default_rng(seed)
        centres = world.sample_free(count, self._rng, CLEARANCE)
        self.robots = [CirclingRobot(f"bench-{k}", centre, k / count) for k, centre in enumerate(centres)]
        self._buses = {robot.name: bus.for_robot(robot.name) for robot in self.robots}
        self._inbox = Inbox(capacity=1_000_000)
        bus.subscribe(BELIEF, self._inbox, keep_all=True, robot="*")

    def wait_matching(self, count: int, timeout: float) -> bool:
        """Whether each of the first ``count`` robots' scans gets a subscriber within ``timeout`` s."""
        deadline = time.monotonic() + timeout
        return all(
            self._buses[robot.name].wait_matching(SCAN, deadline - time.monotonic()) for robot in self.robots[:count]
        )

    def message_sizes(self) -> dict[str, int]:
        """Largest payload in bytes of each topic between one robot and its estimator, without zenoh's headers."""
        robot, inbox = self.robots[0], Inbox()
        ends = [
            self._buses[robot.name].subscribe(topic, inbox, keep_all=True) for topic in (BELIEF, PREDICTION, HEALTH)
        ]
        self.play(1, 2.5)
        for end in ends:
            end()
        found = {"scan": len(self._payload(robot, robot.scans))}
        while isinstance(sample := inbox.get(0), Sample):
            found[sample.topic.name] = max(found.get(sample.topic.name, 0), len(sample.payload))
        return found

    def play(
        self, count: int, seconds: float, rate: float | None = None, *, searching: bool = False
    ) -> AnswerStatistics:
        """Sends scans of the first ``count`` robots for ``seconds`` s, and returns how they were answered.

        ``rate`` in Hz defaults to the load's rate. With ``searching``, the first robot requests a global localisation
        once a second and is left out of the result.
        """
        rate = rate or self.rate
        schedule = sorted(
            (
                ((k + robot.phase) / rate, robot, robot.scans + k)
                for robot in self.robots[:count]
                for k in range(max(1, int(seconds * rate)))
            ),
            key=lambda row: row[0],
        )
        payloads = [self._payload(robot, k) for _, robot, k in schedule]
        while self._inbox.get(0) is not None:
            pass  # discard late answers to the previous measurement
        sent: dict[tuple[str, int], int] = {}
        searching_robot = self.robots[0] if searching else None
        began = time.monotonic()
        for (due, robot, k), payload in zip(schedule, payloads, strict=True):
            time.sleep(max(0.0, began + due - time.monotonic()))
            if robot is not searching_robot:
                sent[BELIEF.key(robot.name), self._stamp(k)] = time.monotonic_ns()
            elif k % round(rate) == 0:
                self._buses[robot.name].send_request(LOCALISE, LocaliseRequest(), k, Inbox())
            self._buses[robot.name].put(SCAN, payload)
            robot.scans = k + 1
        return self._window(count, sent)

    def _stamp(self, k: int) -> int:
        return int((k + 1) / self.rate * 1e9)

    def _payload(self, robot: CirclingRobot, k: int) -> bytes:
        scanner, laser = self.scanner, se2.compose(robot.pose(k, self.rate), self.scanner.mount)
        clean = self.world.ray_distances(laser[None], scanner.angles())[0]
        noisy = clean + scanner.sigma * self._rng.standard_normal(len(clean))
        return Scan.of_scanner(scanner, noisy, self._stamp(k), seq=k, scan_time=1 / self.rate).encode()

    def _window(self, count: int, sent: dict[tuple[str, int], int]) -> AnswerStatistics:
        """Matches the received answers to the scans in ``sent``, waiting up to `ANSWER_TIMEOUT_S` for the last ones."""
        deadline = time.monotonic() + ANSWER_TIMEOUT_S
        latency: dict[tuple[str, int], float] = {}  # ms
        states: dict[str, str] = {}  # of each robot's last belief
        while len(latency) < len(sent) and (left := deadline - time.monotonic()) > 0:
            sample = self._inbox.get(left)
            if not isinstance(sample, Sample):
                continue
            try:
                belief = Belief.decode(sample.payload)
            except DecodeError:
                continue
            key = sample.key, belief.stamp_ns
            if key in sent and key not in latency:
                latency[key] = (sample.received_ns - sent[key]) * 1e-6
                states[sample.key] = belief.state
        values = np.array(list(latency.values()))
        in_time = int((values <= 1e3 / self.rate).sum()) if len(values) else 0
        tracking = sum(state == "tracking" for state in states.values())
        return AnswerStatistics(count, len(sent), len(latency), in_time, values, tracking)
