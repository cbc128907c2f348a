"""A synthetic session whose statistics can be computed by hand, written with RecordingWriter."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np

from common.geometry import se2
from common.geometry.world import Box, Circle, Obstacle, Start, World
from common.messages.definitions import (
    Belief,
    Goal,
    Health,
    Pose,
    Prediction,
    Scan,
    Stamped,
    Status,
    TopicHealth,
    Truth,
    Twist,
)
from common.messages.requests import WorldReply
from common.messages.topics import BELIEF, GOAL, HEALTH, PREDICTION, SCAN, STATUS, TRUTH, Topic
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from services.recorder.files.writer import RecordingWriter
from services.recorder.recording import write_description

WORLD = World(
    name="hall",
    boundary=[(0, 0), (10, 0), (10, 5), (0, 5)],
    obstacles=[
        Obstacle(box=Box(center=(3, 4), size=(1, 0.5), yaw_deg=20)),
        Obstacle(circle=Circle(center=(6, 4), radius=0.5)),
        Obstacle(polygon=[(8, 4), (9, 4), (8.5, 4.8)]),
    ],
    start=Start(x=1, y=1),
)
SCANNER = SCANNERS["tim571"].with_beams(91)
PERIOD_NS = 100_000_000
BEGAN_NS = 1_700_000_000_000_000_000
SCANS = 100
LOCALISED = 20  # index of the first belief in state tracking
MOVED = 30  # index of the scan after which the goal comes and the robot leaves
SPEED = 0.1  # m per scan
GOAL_MESSAGE = Goal(stamp_ns=0, pose=Pose(x=8, y=1), tolerance=0.15)  # as `presage goal` sends it, without a stamp


def true_x(i: int) -> float:
    """True x in m: 1 until scan `MOVED`, then increasing along y = 1."""
    return 1.0 + SPEED * max(0, i - MOVED)


def error(i: int) -> float:
    """Error in m: falls from 2 by 0.1 per scan until localised, then 0.05 standing and 0.2 driving."""
    return 2.0 - 0.1 * i if i < LOCALISED else 0.05 if i <= MOVED else 0.2


def events() -> list[tuple[Topic, str, Stamped, int]]:
    """Topic, publishing service, message and reception time in ns of each message."""
    rng = np.random.default_rng(1)
    found: list[tuple[Topic, str, Stamped, int]] = []
    for i in range(SCANS):
        stamp, at = i * PERIOD_NS, BEGAN_NS + i * PERIOD_NS
        pose = np.array([true_x(i), 1.0, 0.0])
        mount = np.array(SCANNER.mount)
        exact = WORLD.ray_distances(se2.compose(pose, mount)[None], SCANNER.angles())[0]
        noisy = exact + rng.normal(0, SCANNER.sigma, exact.shape)
        seen = np.array([true_x(i) + error(i), 1.0, 0.0])
        expected = WORLD.ray_distances(se2.compose(seen, mount)[None], SCANNER.angles())[0]
        geometry = {"angle_min": SCANNER.angle_min, "angle_increment": SCANNER.angle_increment}
        truth = Truth(stamp_ns=stamp, pose=Pose.of(pose), twist=Twist(), contact=i in {40, 41, 42})
        scan = Scan(
            stamp_ns=stamp,
            **geometry,
            range_min=0.05,
            range_max=25.0,
            ranges=noisy,
            mount=Pose.of(mount),
            scan_time=0.1,
        )
        accuracy = float(np.square(noisy - expected).sum() / 2 / 0.1**2)
        belief = Belief(
            stamp_ns=stamp, state="localising" if i < LOCALISED else "tracking", pose=Pose.of(seen),
            xi=np.zeros(3, np.float32), free_energy=accuracy + 10, accuracy=accuracy, complexity=10.0,
            estimator="paper",
        )  # fmt: skip
        prediction = Prediction(
            stamp_ns=stamp, **geometry, ranges=expected, sigma=np.full(len(expected), 0.1, np.float32)
        )
        found += [(TRUTH, "simulator", truth, at), (SCAN, "simulator", scan, at + 1_000_000)]
        if i == MOVED:
            found.append((GOAL, "demo", GOAL_MESSAGE, at + 2_000_000))
        found += [(BELIEF, "estimator", belief, at + 5_000_000), (PREDICTION, "estimator", prediction, at + 5_000_000)]
        if i >= MOVED:
            away = abs(8.0 - seen[0])
            state = "reached" if away <= GOAL_MESSAGE.tolerance else "navigating"
            status = Status(stamp_ns=stamp, state=state, goal=GOAL_MESSAGE.pose, distance=away)
            found.append((STATUS, "controller", status, at + 6_000_000))
    for service, dropped in (("estimator", 3), ("controller", 4)):
        for count in (1, dropped):  # counters grow; the last message is the valid one
            rows = [TopicHealth(key=SCAN.key("robot"), received=100, dropped=count)]
            health = Health(stamp_ns=1, service=service, uptime=1.0, topics=rows)
            found.append((HEALTH, service, health, BEGAN_NS + SCANS * PERIOD_NS))
    return found


def write(path: Path, *leave_out: Topic, world: bool = True, metadata: dict[str, dict[str, str]] | None = None) -> Path:
    """The session as a recording, without some topics, and with further ``metadata``."""
    writer = RecordingWriter(path)
    for name, values in {"presage": {"robot": "robot"}, **(metadata or {})}.items():
        writer.metadata(name, values)
    if world:
        write_description(writer, "simulator", WorldReply(world=WORLD, scanner=SCANNER, robot=Robot(radius=0.3)))
    for topic, service, message, at in events():
        if topic not in leave_out:
            writer.write(topic, topic.key("robot", service), message.encode(), at, at)
    return writer.finish()


class FullDisk:
    """A file that raises an error after a number of bytes, like a full disk."""

    def __init__(self, stream, room):
        self.stream, self.room = stream, room

    def write(self, data):
        if self.stream.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.stream.write(data)

    def __getattr__(self, name):
        return getattr(self.stream, name)


def on_full_disk(writer: RecordingWriter, room: int) -> RecordingWriter:
    """The same writer, whose file raises an error after ``room`` bytes."""
    writer._stream = writer._writer._Writer__stream = FullDisk(writer._stream, room)
    return writer
