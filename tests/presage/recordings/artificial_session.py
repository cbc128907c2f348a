"""A short artificial session with messages on every topic, whose exports can be computed by hand."""

from __future__ import annotations

import numpy as np

from common.geometry import se2
from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from common.messages.definitions import (
    Belief,
    BeliefHypothesis,
    CmdVel,
    Drive,
    Goal,
    Health,
    LearnedField,
    Map,
    Odom,
    Plan,
    Pose,
    Prediction,
    Preference,
    Scan,
    Status,
    TopicHealth,
    Truth,
    Twist,
)
from common.messages.requests import WorldReply
from common.messages.topics import (
    BELIEF,
    CMD_VEL,
    DRIVE,
    FIELD,
    GOAL,
    HEALTH,
    MAP,
    ODOM,
    PLAN,
    PREDICTION,
    PREFERENCE,
    SCAN,
    STATUS,
    TRUTH,
)
from common.robot.robot import Robot
from services.recorder.files.writer import RecordingWriter
from services.recorder.recording import write_description
from tests.recorder.sessions import SCANNER, WORLD

STEPS = 12
PERIOD_NS = 100_000_000
BEGAN_NS = 1_700_000_000_000_000_000
ODOM_BEGAN = np.array([5.0, -2.0, 0.7])  # start pose in odom; in map it is (1, 1, 0)
SENSED_NS, BELIEVED_NS = 1_000_000, 9_000_000  # after the truth of the same stamp
COVARIANCE = np.diag([0.04, 0.01, 0.0025])
GOAL_AT = 4  # after this step
RANGES = np.array([1.0, np.inf, -np.inf, 2.5], np.float32)
PLANNED = Plan(stamp_ns=GOAL_AT * PERIOD_NS, path=[(1, 1), (8, 1)], motion=[(1, 1), (1.2, 1)], obstacles=[(3, 1)])
PREFERRED = Preference(
    stamp_ns=GOAL_AT * PERIOD_NS, goal=Pose(x=8.0, y=1.0), origin=Pose(x=0.5, y=0.25), resolution=0.5, width=3,
    height=2, distance=[0.0, 0.5, np.inf, 0.5, 1.0, np.inf],
)  # fmt: skip
GROWN = Map(
    stamp_ns=GOAL_AT * PERIOD_NS,
    grid=OccupancyGrid.of(np.array([[FREE, OCCUPIED, UNKNOWN]], np.uint8), 0.05, (1.0, 2.0, 0.0)),
    poses=[(1, 1, 0)],
)
LEARNED = LearnedField(stamp_ns=GOAL_AT * PERIOD_NS, version=1, data=np.zeros(8, np.uint8))


def true(i):
    """True pose: 0.1 m per step along y = 1, turning."""
    return np.array([1.0 + 0.1 * i, 1.0, 0.05 * i])


def believed(i):
    """Believed pose, with errors of 0.03 m, 0.04 m and 0.01 rad."""
    return true(i) + np.array([0.03, 0.04, 0.01])


def odometry(i):
    return se2.compose(ODOM_BEGAN, se2.between(true(0), true(i)))


def belief(i):
    hypotheses = [
        BeliefHypothesis(pose=Pose.of(believed(i)), covariance=COVARIANCE, weight=0.75),
        BeliefHypothesis(pose=Pose(x=7.0, y=3.0), weight=0.25),
    ]
    return Belief(
        stamp_ns=i * PERIOD_NS, seq=i, state="ambiguous" if i < 3 else "tracking", pose=Pose.of(believed(i)),
        covariance=COVARIANCE, xi=[1.0, 2.0, 3.0], free_energy=100.0 + i, accuracy=90.0, complexity=10.0 + i,
        hypotheses=hypotheses, estimator="precise",
        probability=0.875, protection=[0.5, 0.25, 0.125],
    )  # fmt: skip


def events(robot="rob"):
    """Yields topic, key, message and reception time in ns."""
    for i in range(STEPS):
        stamp, at = i * PERIOD_NS, BEGAN_NS + i * PERIOD_NS
        twist = Twist(vx=1.0, wz=0.5)
        truth = Truth(stamp_ns=stamp, seq=i, pose=Pose.of(true(i)), twist=twist, contact=i == 5)
        odom = Odom(stamp_ns=stamp, seq=i, pose=Pose.of(odometry(i)), twist=twist, covariance=COVARIANCE)
        geometry = {"angle_min": -0.3, "angle_increment": 0.2}
        scan = Scan(
            stamp_ns=stamp, seq=i, **geometry, range_min=0.05, range_max=25.0, ranges=RANGES,
            mount=Pose(x=0.2, y=0.0), scan_time=0.1,
        )  # fmt: skip
        prediction = Prediction(stamp_ns=stamp, seq=i, **geometry, ranges=RANGES[[0, 0, 0, 3]], sigma=[0.1] * 4)
        yield TRUTH, TRUTH.key(robot), truth, at
        yield ODOM, ODOM.key(robot), odom, at + SENSED_NS // 2
        yield SCAN, SCAN.key(robot), scan, at + SENSED_NS
        yield BELIEF, BELIEF.key(robot), belief(i), at + BELIEVED_NS
        yield PREDICTION, PREDICTION.key(robot), prediction, at + BELIEVED_NS
        if i == GOAL_AT:
            yield GOAL, GOAL.key(robot), Goal(stamp_ns=0, pose=Pose(x=8.0, y=1.0), tolerance=0.25), at + BELIEVED_NS
            yield PLAN, PLAN.key(robot), PLANNED, at + BELIEVED_NS
            yield PREFERENCE, PREFERENCE.key(robot), PREFERRED, at + BELIEVED_NS
            yield MAP, MAP.key(robot), GROWN, at + BELIEVED_NS
            yield FIELD, FIELD.key(robot), LEARNED, at + BELIEVED_NS
            yield DRIVE, DRIVE.key(robot), Drive(stamp_ns=stamp, twist=twist), at + BELIEVED_NS
        state, distance = ("navigating", 3.5) if i >= GOAL_AT else ("idle", None)
        status = Status(stamp_ns=stamp, seq=i, state=state, reason="on the way" * (i >= GOAL_AT), distance=distance)
        yield STATUS, STATUS.key(robot), status, at + BELIEVED_NS + 1
        yield CMD_VEL, CMD_VEL.key(robot), CmdVel(stamp_ns=stamp, seq=i, twist=twist), at + BELIEVED_NS + 2
        if i in {1, 11}:
            note = "no scan yet" if i == 1 else ""
            rows = [TopicHealth(key=SCAN.key(robot), received=i, dropped=2, rate=10.0)]
            health = Health(
                stamp_ns=1, seq=i // 11, service="estimator", uptime=1.0, topics=rows, counters={"steps": i}, note=note
            )
            yield HEALTH, HEALTH.key(robot, "estimator"), health, at + BELIEVED_NS + 3


def write(path, *leave_out, robot="rob", world=True, finish=True, also=()):
    """Writes the session as a recording, without the topics ``leave_out``.

    With ``finish`` False the recording stays incomplete and its name ends in .active.
    """
    writer = RecordingWriter(path)
    writer.metadata("presage", {"robot": robot, "commit": "abc"})
    if world:
        write_description(writer, "simulator", WorldReply(world=WORLD, scanner=SCANNER, robot=Robot(radius=0.3)))
    for topic, key, message, at in events(robot):
        if topic not in leave_out:
            writer.write(topic, key, message.encode(), at, at)
    for topic, key, payload, at in also:
        writer.write(topic, key, payload, at, at)
    if finish:
        return writer.finish()
    writer.flush()
    writer._stream.close()
    return writer.active
