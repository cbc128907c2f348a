"""A session as Foxglove messages.

Time. Viewers play by log time, which is the wall clock of the recording. Our stamps are simulation or sensor time, so
each stamp is turned into the wall-clock time at which the first sensor message (scan, odom, truth) that bears it was
recorded: scan, prediction, belief and transforms of one stamp get one and the same time, on the viewers' own clock.

Frames. map → odom → base_link → laser. odom → base_link is the odometry; map → odom is its correction, so that
base_link stands in map where the driving pose of the same stamp says: the belief; in a recording without beliefs the
truth; without either the odometry itself. Without odometry map and odom are one.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message as Protobuf

from common.geometry.se2 import Array, between, compose
from common.geometry.world import World
from common.messages.definitions import (
    Belief,
    CmdVel,
    Drive,
    Goal,
    Health,
    Odom,
    Plan,
    Prediction,
    Preference,
    Scan,
    Stamped,
    Status,
    Truth,
)
from common.messages.topics import Topic
from common.robot.base import Robot
from presage.recordings import foxglove_shapes as shapes
from presage.recordings import plain_numbers as numbers
from services.recorder.reader import Raw

REMEMBERED = 4096  # stamps; a belief comes a few scans after its scan at most
WARNED = {"lost", "blocked"}


@dataclass(frozen=True)
class Out:
    """One message of the export: a protobuf of Foxglove's, or plain values that become JSON."""

    topic: str
    content: Protobuf | dict[str, Any]
    log_ns: int
    publish_ns: int


class Recent(OrderedDict[int, Any]):
    """The last values by stamp."""

    def keep(self, stamp: int, value: Any) -> None:
        """The newest value of a stamp."""
        self[stamp] = value
        self.move_to_end(stamp)
        if len(self) > REMEMBERED:
            self.popitem(last=False)


class Clock:
    """The wall-clock time of each stamp."""

    def __init__(self) -> None:
        self._recent = Recent()

    def see(self, topic: str, stamp: int, logged_ns: int) -> int:
        """A sensor message; a stamp that a topic had before is of a simulation begun anew. Its time in ns."""
        known = self._recent.get(stamp)
        if known is None or topic in known[1]:
            known = (logged_ns, set[str]())
            self._recent.keep(stamp, known)
        known[1].add(topic)
        return int(known[0])

    def of(self, stamp: int, otherwise_ns: int) -> int:
        """The time of a stamp that some sensor message had, or else the other."""
        known = self._recent.get(stamp)
        return int(known[0]) if known is not None else otherwise_ns


def driver_of(names: set[str]) -> str:
    """Which topic's pose moves base_link in map, of those there are."""
    return next((name for name in ("belief", "truth", "odom") if name in names), "odom")


class SessionView:
    """Turns our messages into Foxglove's."""

    def __init__(self, driver: str) -> None:
        """``driver``: belief, truth or odom, see the module."""
        self.driver = driver
        self.left_out: Counter[str] = Counter()  # messages of topics that have no form here, by topic
        self._clock = Clock()
        self._odoms, self._truths = Recent(), Recent()
        self._chain: dict[str, tuple[str, Array, int]] = {}  # child: parent, pose, ns
        self._driving: tuple[int, Array] = (-1, np.zeros(3))  # the last stamp and pose of the driver
        self._goal: Array | None = None
        self._said: dict[str, str] = {}  # by name: what the log said last
        self._makers: dict[type[Stamped], Callable[[Any, int, int], Iterator[tuple[str, Any]]]] = {
            Scan: self._scan, Odom: self._odom, Truth: self._truth, Belief: self._belief, Prediction: self._prediction,
            Goal: self._new_goal, CmdVel: self._command, Status: self._status, Health: self._health,
            Drive: self._drive, Plan: self._plan, Preference: self._preference,
        }  # fmt: skip

    def feed(self, topic: Topic, message: Stamped, raw: Raw) -> Iterator[Out]:
        """What one message becomes; of a topic that has no form here nothing, and it is counted in `left_out`."""
        make = self._makers.get(type(message))
        if make is None:
            self.left_out[topic.name] += 1
            return
        logged = raw.logged_ns
        sensor = isinstance(message, Scan | Odom | Truth)
        at = (
            self._clock.see(topic.name, message.stamp_ns, logged)
            if sensor
            else self._clock.of(message.stamp_ns, logged)
        )
        for name, content in make(message, at, logged):
            yield Out(name, content, logged, raw.published_ns)

    def _scan(self, scan: Scan, at: int, _: int) -> Iterator[tuple[str, Any]]:
        if "laser" not in self._chain or not np.array_equal(self._chain["laser"][1], scan.mount.array()):
            yield self._moved("base_link", "laser", scan.mount.array(), at)
        yield "/scan", shapes.laser_scan(scan, at)

    def _prediction(self, prediction: Prediction, at: int, _: int) -> Iterator[tuple[str, Any]]:
        yield "/prediction", shapes.laser_scan(prediction, at)

    def _odom(self, odom: Odom, at: int, _: int) -> Iterator[tuple[str, Any]]:
        pose = odom.pose.array()
        self._odoms.keep(odom.stamp_ns, pose)
        if self.driver == "odom" and "odom" not in self._chain:
            self._chain["odom"] = ("map", np.zeros(3), at)
        stamp, driving = self._driving
        if stamp == odom.stamp_ns:  # the pose of this stamp came before the odometry
            self._chain["odom"] = ("map", compose(driving, between(pose, np.zeros(3))), at)
        yield self._moved("odom", "base_link", pose, at)
        yield "/odom", shapes.pose_in("odom", pose, at)

    def _truth(self, truth: Truth, at: int, _: int) -> Iterator[tuple[str, Any]]:
        self._truths.keep(truth.stamp_ns, truth.pose.array())
        yield "/truth", shapes.pose_in("map", truth.pose.array(), at)
        yield "/truth/numbers", numbers.of_truth(truth)
        if self.driver == "truth":
            yield self._corrected(truth.pose.array(), truth.stamp_ns, at)

    def _belief(self, belief: Belief, at: int, logged: int) -> Iterator[tuple[str, Any]]:
        pose = belief.pose.array()
        yield self._corrected(pose, belief.stamp_ns, at)
        yield "/belief", shapes.pose_in("map", pose, at)
        poses = [shapes.pose(each.pose.array()) for each in shapes.hypotheses(belief)]
        yield "/hypotheses", PosesInFrame(timestamp=shapes.time_of(at), frame_id="map", poses=poses)
        yield "/belief/shape", SceneUpdate(entities=[shapes.belief_entity(belief, at)])
        yield "/belief/numbers", numbers.of_belief(belief)
        if (truth := self._truths.get(belief.stamp_ns)) is not None:
            yield "/error", numbers.of_error(belief, truth, self._goal)
        yield from self._log("estimator", belief.state, f"belief is {belief.state}", logged)

    def _new_goal(self, goal: Goal, _: int, logged: int) -> Iterator[tuple[str, Any]]:
        at = shapes.time_of(logged)  # a goal's own stamp may be of another clock
        if goal.cancel:
            self._goal = None
            yield "/goal/shape", SceneUpdate(deletions=[SceneEntityDeletion(timestamp=at, id="goal")])
            yield from self._log("goal", f"cancelled {logged}", "the goal was cancelled", logged)
            return
        self._goal = goal.pose.array()
        yield "/goal", shapes.pose_in("map", self._goal, logged)
        entity = shapes.disc("map", "goal", self._goal, goal.tolerance, 0.02, shapes.GOAL, 0.5, logged)
        yield "/goal/shape", SceneUpdate(entities=[entity])
        said = f"goal ({goal.pose.x:g}, {goal.pose.y:g}) m, within {goal.tolerance:g} m"
        yield from self._log("goal", f"{said} {logged}", said, logged)

    def _command(self, command: CmdVel, _at: int, _logged: int) -> Iterator[tuple[str, Any]]:
        yield "/cmd_vel", numbers.of_command(command)

    def _drive(self, drive: Drive, _at: int, _logged: int) -> Iterator[tuple[str, Any]]:
        yield "/drive", numbers.of_command(drive)

    def _plan(self, plan: Plan, at: int, _: int) -> Iterator[tuple[str, Any]]:
        yield "/plan", SceneUpdate(entities=[shapes.plan_entity(plan, at)])
        yield "/plan/obstacles", shapes.obstacle_points(plan, at)

    def _preference(self, preference: Preference, at: int, _: int) -> Iterator[tuple[str, Any]]:
        yield "/preference", shapes.preference_grid(preference, at)

    def _status(self, status: Status, _: int, logged: int) -> Iterator[tuple[str, Any]]:
        yield "/status", numbers.of_status(status)
        said = f"{status.state}: {status.reason}" if status.reason else status.state
        # A reason may count down; what is new is the state.
        yield from self._log("controller", status.state, said, logged)

    def _health(self, health: Health, _: int, logged: int) -> Iterator[tuple[str, Any]]:
        yield f"/health/{health.service}", numbers.of_health(health)
        if health.note or health.service in self._said:
            said = health.note or "no complaint any more"
            yield from self._log(health.service, health.note, said, logged, warn=bool(health.note), topic="health")

    def _log(self, name: str, what: str, said: str, ns: int, *, warn: bool | None = None, topic: str = "") -> Iterator[
        tuple[str, Any]
    ]:  # fmt: skip
        """A line where something is new."""
        if self._said.get(topic + name) == what:
            return
        self._said[topic + name] = what
        level = Log.WARNING if (what in WARNED if warn is None else warn) else Log.INFO
        yield "/log", Log(timestamp=shapes.time_of(ns), level=level, message=said, name=name)

    def _moved(self, parent: str, child: str, pose: Array, at: int) -> tuple[str, FrameTransforms]:
        """The whole chain as it is known now, each link with the time of its own measurement."""
        self._chain[child] = (parent, pose, at)
        links = [shapes.transform(of, to, pose, ns) for to, (of, pose, ns) in self._chain.items()]
        return "/tf", FrameTransforms(transforms=links)

    def _corrected(self, pose: Array, stamp: int, at: int) -> tuple[str, FrameTransforms]:
        """Sets map → odom so that base_link stands at ``pose`` (3,) in map, against the odometry of the same stamp."""
        self._driving = (stamp, pose)
        odom = self._odoms.get(stamp)
        if odom is None:
            odom = next(reversed(self._odoms.values()), None)
        if odom is None:  # no odometry: base_link stands in odom where it stands in map
            self._chain["odom"] = ("map", np.zeros(3), at)
            return self._moved("odom", "base_link", pose, at)
        correction = compose(pose, between(odom, np.zeros(3)))
        return self._moved("map", "odom", correction, at)


def still_life(world: World | None, robot: Robot, believed: Array, true: Array, ns: int) -> Iterator[Out]:
    """What stands from the beginning: map, walls, the robot's body, and the whole paths (N, 3) in map."""
    if world is not None:
        yield Out("/map", shapes.grid(world, ns), ns, ns)
        yield Out("/world", SceneUpdate(entities=shapes.world_entities(world, ns)), ns, ns)
    body = shapes.disc("base_link", "robot", np.zeros(3), robot.radius, 0.25, shapes.BELIEF, 0.4, ns)
    yield Out("/robot", SceneUpdate(entities=[body]), ns, ns)
    paths = (("believed path", believed, shapes.BELIEF), ("true path", true, shapes.TRUTH))
    drawn = [shapes.path_entity(name, path, rgb, ns) for name, path, rgb in paths if len(path) > 1]
    if drawn:
        yield Out("/paths", SceneUpdate(entities=drawn), ns, ns)
