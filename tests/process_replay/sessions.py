"""Short sessions, generated from a seed, each for one service.

No service's output is used as another's input, so a change in a service changes only its own reference.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.geometry import se2
from common.geometry.world import Box, Obstacle, load_world
from common.messages.definitions import Belief, CmdVel, Drive, Goal, Odom, Pose, Scan, Twist
from common.messages.requests import (
    ConfigReply,
    LocaliseRequest,
    ModelReply,
    ModelRequest,
    ObstacleRequest,
    PoseRequest,
    Request,
    ResetRequest,
    SampleRequest,
    SpeedRequest,
    WorldReply,
)
from common.messages.topics import (
    BELIEF,
    CMD_VEL,
    DRIVE,
    GOAL,
    LOCALISE,
    MODEL,
    OBSTACLE,
    ODOM,
    PAUSE,
    RESET,
    RESUME,
    SAMPLE,
    SCAN,
    SPEED,
    STEP,
    TELEPORT,
    WORLD,
)
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from common.runtime.service import ServiceLoop
from services.controller.service import ControllerService
from services.controller.settings import ControllerSettings
from services.estimator.service import EstimatorService
from services.estimator.settings import EstimatorSettings
from services.recorder.reader import read_recording
from services.recorder.service import RecorderService
from services.recorder.settings import RecorderSettings
from services.simulator.service import SimulatorService
from services.simulator.settings import SimulatorSettings
from tests.process_replay.harness import ROBOT, TIMER, Event, FakeBus, drive, sample
from tests.process_replay.reference import Row

SEED = 5
PERIOD_NS = 66_666_667
CORRIDOR = load_world("corridor")
SCANNER = SCANNERS["tim571"].with_beams(622)
NORTH = np.pi / 2  # the heading for which preset paper is trained


def scan_at(number: int, pose: np.ndarray, rng: np.random.Generator, **changes: Any) -> Scan:
    """Scan at base_link ``pose`` (3,): exact rays with the scanner's noise."""
    exact = CORRIDOR.ray_distances(se2.compose(pose, np.array(SCANNER.mount))[None], SCANNER.angles())[0]
    ranges = SCANNER.limit(exact + SCANNER.sigma * rng.standard_normal(len(exact)))
    values = {
        "angle_min": SCANNER.angle_min, "angle_increment": SCANNER.angle_increment, "range_min": SCANNER.range_min,
        "range_max": SCANNER.range_max, "ranges": ranges, "mount": Pose.of(SCANNER.mount), "scan_time": 1 / 15,
    }  # fmt: skip
    return Scan(stamp_ns=number * PERIOD_NS, **{**values, **changes})


def simulator_events() -> Iterator[Event]:
    """Driving, turning, a wall, a teleport, new obstacles; and late, foreign and malformed commands."""

    def command(number: int, vx: float, vy: float = 0.0, wz: float = 0.0) -> Event:
        return Event.of(CMD_VEL, CmdVel(stamp_ns=number * PERIOD_NS, twist=Twist(vx=vx, vy=vy, wz=wz)))

    yield TIMER  # the first scan
    yield Event.of(WORLD, Request())
    for number in range(4):
        yield command(number, 0.8, 0.2, 0.5)
    yield command(2, 0.1)  # answers a scan of long ago
    yield Event(CMD_VEL, b"no message")
    for number in range(4, 7):
        yield command(number, 0.0, 3.0)  # above the speed limit
    yield Event.of(TELEPORT, PoseRequest(pose=Pose(x=1.0, y=0.1)))  # too close to a wall
    yield Event.of(TELEPORT, PoseRequest(pose=Pose(x=9.0, y=3.0, yaw=NORTH)))
    box = Obstacle(box=Box(center=(9.0, 4.0), size=(0.6, 0.3), yaw_deg=20))
    yield Event.of(OBSTACLE, ObstacleRequest(action="add", name="crate", obstacle=box))
    yield Event.of(OBSTACLE, ObstacleRequest(action="add", name="crate", obstacle=box))
    for number in range(7, 11):
        yield command(number, 1.0)  # the crate stops it
    yield Event.of(PAUSE, Request())
    yield Event.of(RESUME, Request())
    poses = np.array([[3.0, 1.5, 0.0], [9.0, 1.0, 2.0]])
    yield Event.of(SAMPLE, SampleRequest(poses=poses, beams=61, noise=True, seed=1))
    yield Event.of(RESET, ResetRequest(seed=9))
    yield TIMER
    yield command(0, 0.5)
    yield Event.of(SPEED, SpeedRequest(factor=2.0))  # refused in lockstep
    yield Event.of(STEP, Request())  # refused while not paused
    yield Event.of(PAUSE, Request())
    yield Event.of(STEP, Request())  # this scan has no command yet
    yield command(1, 0.5)
    yield command(1, 0.0)  # a second command for the same scan
    yield Event.of(STEP, Request())
    yield command(2, 0.5)
    yield Event.of(STEP, Request())


def estimator_events() -> Iterator[Event]:
    """Global localisation, driving and a new pose; a repeated scan, a scan of another scanner, a malformed scan."""
    rng = np.random.default_rng(SEED)
    yield Event.of(MODEL, ModelRequest())
    yield Event.of(LOCALISE, LocaliseRequest())
    for number in range(12):
        pose = np.array([9.2 + 0.05 * number, 2.2 - 0.02 * number, NORTH])
        scan = scan_at(number, pose, rng)
        if number == 3:
            yield Event.of(GOAL, Goal(stamp_ns=0, pose=Pose(x=12.0, y=1.5)))
        if number == 5:
            blind = np.where(np.arange(622) < 200, np.inf, scan.ranges)
            scan = scan.model_copy(update={"ranges": blind.astype(np.float32)})
        if number == 8:
            yield Event.of(LOCALISE, LocaliseRequest(pose=Pose(x=9.4, y=2.0, yaw=NORTH)))
        yield Event.of(SCAN, scan)
        if number == 6:
            yield Event.of(SCAN, scan)
            yield Event(SCAN, b"\x81\xa8stamp_ns\x01")
    few = SCANNER.with_beams(90)
    yield Event.of(SCAN, scan_at(12, np.array([9.8, 1.96, NORTH]), rng, angle_increment=few.angle_increment))
    yield Event.of(MODEL, ModelRequest())


def controller_events() -> Iterator[Event]:
    """Goals refused, accepted, reached and cancelled; unsure, repeated and missing beliefs; manual driving."""
    rng = np.random.default_rng(SEED)
    target = np.array([5.2, 1.5])
    for number in [*range(48), 64, 81, 82, *range(90, 112)]:
        state = "localising" if number < 4 else "ambiguous" if number in {10, 11} else "tracking"
        position = np.array([3.2, 1.4]) + (target - [3.2, 1.4]) * min(1.0, max(0, number - 4) / 31)
        goal = {1: Goal(stamp_ns=0, seq=1, pose=Pose(x=30.0, y=1.0)),
                2: Goal(stamp_ns=0, seq=2, pose=Pose(x=5.2, y=1.5), tolerance=0.2),
                47: Goal(stamp_ns=0, seq=3, pose=Pose(x=9.0, y=1.5)),
                82: Goal(stamp_ns=0, seq=4, pose=Pose(x=9.0, y=1.5), cancel=True),
                90: Goal(stamp_ns=0, seq=5, pose=Pose(x=3.4, y=1.5))}.get(number)  # fmt: skip
        if goal is not None:
            yield Event.of(GOAL, goal)
        scan = scan_at(number, np.array([*position, 0.1]), rng)
        if number in range(92, 104):  # stands under manual control until the goal becomes active again
            yield Event.of(DRIVE, Drive(stamp_ns=0, twist=Twist(vx=-0.3, vy=2.0, wz=0.5) if number < 96 else Twist()))
        if number in {18, 19, 47, 64, 81}:  # a person in front of the robot, from 47 on closer
            near = np.where(np.abs(scan.angles()) < 0.3, 0.25 if number < 47 else 0.12, scan.ranges)
            scan = scan.model_copy(update={"ranges": near.astype(np.float32)})
        yield Event.of(SCAN, scan)
        belief = Belief(
            stamp_ns=scan.stamp_ns, state=state, pose=Pose(x=position[0], y=position[1], yaw=0.1),
            covariance=np.diag([1e-4, 1e-4, 1e-5]), xi=rng.normal(0, 200, 3), curvature=np.diag([2e4, 3e4, 9e4]),
            free_energy=1.0, accuracy=1.0, estimator="precise",
        )  # fmt: skip
        yield Event.of(BELIEF, belief)
        if number == 20:
            yield Event.of(BELIEF, belief)
    yield TIMER  # no belief for too long
    for number in range(112, 126):  # manual driving without belief; when its commands end, the robot brakes
        if number < 114:
            yield Event.of(DRIVE, Drive(stamp_ns=0, twist=Twist(vx=-0.8)))
        yield Event.of(SCAN, scan_at(number, np.array([*target, 0.1]), rng))


def simulator(folder: Path, **changes: Any) -> list[Row]:
    """Runs the simulator in lockstep, so that the machine's speed does not matter."""
    settings = {"pace": "lockstep", "seed": SEED, "beams": 622, "robot": ROBOT, "lockstep_deadline": 60.0}
    return drive(SimulatorService(SimulatorSettings(**{**settings, **changes})), simulator_events())


def estimator(name: str) -> Callable[..., list[Row]]:
    """Returns a function that runs the named estimator."""

    def run(folder: Path, **changes: Any) -> list[Row]:
        near = {"initial_pose": "9.2,2.2,90"} if name == "particle-filter" else {}
        settings = {"estimator": name, "seed": SEED, "robot": ROBOT, **near}
        return drive(EstimatorService(EstimatorSettings(**{**settings, **changes})), estimator_events())

    return run


def controller(preset: str) -> Callable[..., list[Row]]:
    """Returns a function that runs the controller with a preset, and with the world, so that it can refuse goals."""

    def run(folder: Path, **changes: Any) -> list[Row]:
        settings = {"world": "corridor", "preset": preset, "robot": ROBOT}
        return drive(ControllerService(ControllerSettings(**{**settings, **changes})), controller_events())

    return run


def recorder(folder: Path, **changes: Any) -> list[Row]:
    """Runs the recorder's loop in a thread, because the loop writes the file. Returns the contents of the file."""
    settings = {"directory": folder, "file": "session.mcap", "robot": ROBOT, **changes}
    service, bus = RecorderService(RecorderSettings(**settings)), FakeBus()
    model = ModelReply(
        estimator="precise", world=CORRIDOR, card="{}", file="corridor-precise.safetensors", size=3, sha256="abc",
        weights=np.array([1, 2, 3], np.uint8),
    )  # fmt: skip
    bus.replies = {
        ("simulator", "config"): ConfigReply(service="simulator", config='{"seed": 5}', versions={"python": "3"}),
        ("simulator", "world"): WorldReply(world=CORRIDOR, scanner=SCANNER, robot=Robot()),
        ("estimator", "config"): ConfigReply(service="estimator", config="{}", versions={"python": "3"}),
        ("estimator", "model"): model,
    }
    loop = ServiceLoop(service, bus, Inbox())  # type: ignore[arg-type]
    thread = threading.Thread(target=loop.run)
    thread.start()
    try:
        assert wait_until(lambda: set(service.inputs) <= bus.subscribed.keys(), 20)
        for number, (topic, payload) in enumerate(recorded_payloads()):
            if topic in bus.subscribed:
                loop.inbox.put(sample(topic, payload, 1_000_000 * (number + 1)))
        active = folder / "session.mcap.active"
        assert wait_until(
            lambda: not len(loop.inbox) and b"model/corridor-precise.safetensors" in active.read_bytes(), 20
        )
    finally:
        loop.stop()
        thread.join(20)
    return list(_rows_of_file(folder / "session.mcap"))


def recorded_payloads() -> Iterator[tuple[Any, bytes]]:
    """Payloads of several topics, with a gap in the sequence numbers and a malformed payload."""
    rng = np.random.default_rng(SEED)
    for number in range(6):
        seq = number if number < 3 else number + 2
        scan = scan_at(number, np.array([3.2, 1.4, NORTH]), rng).model_copy(update={"seq": seq})
        yield SCAN, scan.encode()
        yield ODOM, Odom(stamp_ns=number, seq=number, pose=Pose(x=0, y=0), twist=Twist(), covariance=np.eye(3)).encode()
    yield CMD_VEL, b"no message"


def _rows_of_file(path: Path) -> Iterator[Row]:
    recording = read_recording(path)
    yield {"file": {"complete": recording.complete, "profile": recording.profile}}
    for raw in recording.payloads():
        yield {"message": raw.key, "bytes": len(raw.payload), "logged_ns": raw.logged_ns - recording.start_ns}
    for name, data in sorted(recording.attachments.items()):
        yield {"attachment": name, "bytes": len(data)}
    for name, values in sorted(recording.metadata.items()):
        # Versions, commit and command change often, so only their keys are part of the reference.
        row = {"keys": sorted(values)} if name in {"presage", "config:recorder"} else {"values": values}
        yield {"metadata": name, **row}


SESSIONS: dict[str, Callable[..., list[Row]]] = {
    "simulator": simulator,
    "estimator-precise": estimator("precise"),
    "estimator-paper": estimator("paper"),
    "estimator-particle-filter": estimator("particle-filter"),
    "controller-geodesic": controller("geodesic"),
    "controller-paper": controller("paper"),
    "recorder": recorder,
}
