"""Converts a session to Foxglove messages.

Time: Foxglove plays a file by log time, which is the wall time of the recording. The stamps of presage are simulation
or sensor time. Each stamp is therefore converted to the wall time at which the first sensor message (scan, odom, truth)
with this stamp was recorded: scan, prediction, belief and transforms of the same stamp all get that time.

Frames: map → odom → base_link → laser. odom → base_link is the odometry. map → odom corrects it so that base_link in
map is the pose of the same stamp in one topic, the source of poses: the belief; in a recording without beliefs the
truth; without either the odometry itself. Without odometry, map and odom are the same frame.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message as Protobuf

from common.errors import UserError
from common.geometry.se2 import Array, between, compose
from common.geometry.world import World
from common.messages.definitions import (
    Belief,
    CmdVel,
    Drive,
    Goal,
    Health,
    LearnedField,
    Map,
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
from common.robot.robot import Robot
from presage.recordings import foxglove_numbers as numbers
from presage.recordings import foxglove_shapes as shapes
from services.recorder.reader import RawMessage

MAX_REMEMBERED_STAMPS = 4096  # far more than the delay between a scan and its belief
WARNING_STATES = {"lost", "blocked"}


@dataclass(frozen=True)
class FoxgloveMessage:
    """One message of the export: a protobuf message of Foxglove, or values for JSON."""

    topic: str
    content: Protobuf | dict[str, Any]
    log_ns: int
    publish_ns: int


class RecentValues(OrderedDict[int, Any]):
    """The most recent values by stamp, of a limited number of stamps."""

    def keep(self, stamp: int, value: Any) -> None:
        """Stores the value of a stamp as the most recent."""
        self[stamp] = value
        self.move_to_end(stamp)
        if len(self) > MAX_REMEMBERED_STAMPS:
            self.popitem(last=False)


class WallClock:
    """Converts stamps to wall time."""

    def __init__(self) -> None:
        self._recent = RecentValues()  # by stamp: (wall time in ns, topics with this stamp)

    def add_sensor_message(self, topic: str, stamp: int, logged_ns: int) -> int:
        """Adds a sensor message and returns its wall time in ns.

        A stamp that the topic had before belongs to a restarted simulation and gets a new time.
        """
        known = self._recent.get(stamp)
        if known is None or topic in known[1]:
            known = (logged_ns, set[str]())
            self._recent.keep(stamp, known)
        known[1].add(topic)
        return int(known[0])

    def time_of(self, stamp: int, default_ns: int) -> int:
        """Wall time of a stamp in ns; ``default_ns`` if no sensor message had it."""
        known = self._recent.get(stamp)
        return int(known[0]) if known is not None else default_ns


def pose_source_of(names: set[str]) -> str:
    """The topic, of those in ``names``, whose pose moves base_link in map."""
    return next((name for name in ("belief", "truth", "odom") if name in names), "odom")


class SessionConverter:
    """Converts messages of presage to Foxglove messages."""

    def __init__(self, pose_source: str, world: World | None) -> None:
        """``pose_source`` is belief, truth or odom; see the docstring of the module."""
        self.pose_source, self._world = pose_source, world
        self.left_out: Counter[str] = Counter()  # messages of unsupported topics, by topic
        self._clock = WallClock()
        self._odoms, self._truths = RecentValues(), RecentValues()
        self._chain: dict[str, tuple[str, Array, int]] = {}  # child: (parent, pose, ns)
        self._source_pose: tuple[int, Array] = (-1, np.zeros(3))  # the source's last stamp and pose
        self._goal: Array | None = None
        self._last_log: dict[str, str] = {}  # key of the last log line, by topic and name
        self._converters: dict[type[Stamped], Callable[[Any, int, int], Iterator[tuple[str, Any]]]] = {
            Scan: self._scan,
            Odom: self._odom,
            Truth: self._truth,
            Belief: self._belief,
            Prediction: self._prediction,
            Goal: self._new_goal,
            CmdVel: self._command,
            Status: self._status,
            Health: self._health,
            Drive: self._drive,
            Plan: self._plan,
            Preference: self._preference,
            Map: self._map,
            LearnedField: self._learned_field,
        }

    def convert(self, topic: Topic, message: Stamped, raw: RawMessage) -> Iterator[FoxgloveMessage]:
        """Yields the Foxglove messages for one message; counts messages of unsupported topics in `left_out`."""
        converter = self._converters.get(type(message))
        if converter is None:
            self.left_out[topic.name] += 1
            return
        logged = raw.logged_ns
        sensor = isinstance(message, Scan | Odom | Truth)
        ns = (
            self._clock.add_sensor_message(topic.name, message.stamp_ns, logged)
            if sensor
            else self._clock.time_of(message.stamp_ns, logged)
        )
        for name, content in converter(message, ns, logged):
            yield FoxgloveMessage(name, content, logged, raw.published_ns)

    def _scan(self, scan: Scan, ns: int, _: int) -> Iterator[tuple[str, Any]]:
        if "laser" not in self._chain or not np.array_equal(self._chain["laser"][1], scan.mount.array()):
            yield self._transforms("base_link", "laser", scan.mount.array(), ns)
        yield "/scan", shapes.laser_scan(scan, ns)

    def _prediction(self, prediction: Prediction, ns: int, _: int) -> Iterator[tuple[str, Any]]:
        yield "/prediction", shapes.laser_scan(prediction, ns)

    def _odom(self, odom: Odom, ns: int, _: int) -> Iterator[tuple[str, Any]]:
        pose = odom.pose.array()
        self._odoms.keep(odom.stamp_ns, pose)
        if self.pose_source == "odom" and "odom" not in self._chain:
            self._chain["odom"] = ("map", np.zeros(3), ns)
        stamp, source_pose = self._source_pose
        if stamp == odom.stamp_ns:  # the source's pose of this stamp came before the odometry
            self._chain["odom"] = ("map", compose(source_pose, between(pose, np.zeros(3))), ns)
        yield self._transforms("odom", "base_link", pose, ns)
        yield "/odom", shapes.pose_in("odom", pose, ns)

    def _truth(self, truth: Truth, ns: int, _: int) -> Iterator[tuple[str, Any]]:
        self._truths.keep(truth.stamp_ns, truth.pose.array())
        yield "/truth", shapes.pose_in("map", truth.pose.array(), ns)
        yield "/truth/numbers", numbers.of_truth(truth)
        if self.pose_source == "truth":
            yield self._correction(truth.pose.array(), truth.stamp_ns, ns)

    def _belief(self, belief: Belief, ns: int, logged: int) -> Iterator[tuple[str, Any]]:
        pose = belief.pose.array()
        yield self._correction(pose, belief.stamp_ns, ns)
        yield "/belief", shapes.pose_in("map", pose, ns)
        poses = [shapes.pose(each.pose.array()) for each in shapes.hypotheses(belief)]
        yield "/hypotheses", PosesInFrame(timestamp=shapes.time_of(ns), frame_id="map", poses=poses)
        yield "/belief/shape", SceneUpdate(entities=[shapes.belief_entity(belief, ns)])
        yield "/belief/numbers", numbers.of_belief(belief)
        if (truth := self._truths.get(belief.stamp_ns)) is not None:
            yield "/error", numbers.of_error(belief, truth, self._goal)
        yield from self._log("estimator", belief.state, f"belief is {belief.state}", logged)

    def _new_goal(self, goal: Goal, _: int, logged: int) -> Iterator[tuple[str, Any]]:
        time = shapes.time_of(logged)  # a goal's own stamp may be of another clock
        if goal.cancel or goal.explore:
            self._goal = None
            yield "/goal/shape", SceneUpdate(deletions=[SceneEntityDeletion(timestamp=time, id="goal")])
            text = "exploring" if goal.explore and not goal.cancel else "the goal was cancelled"
            yield from self._log("goal", f"{text} {logged}", text, logged)
            return
        with suppress(UserError):  # the controller refused it
            goal = goal.in_map(self._world)
        self._goal = goal.pose.array()
        yield "/goal", shapes.pose_in("map", self._goal, logged)
        entity = shapes.disc("map", "goal", self._goal, goal.tolerance, 0.02, shapes.GOAL, 0.5, logged)
        yield "/goal/shape", SceneUpdate(entities=[entity])
        text = f"goal ({goal.pose.x:g}, {goal.pose.y:g}) m, within {goal.tolerance:g} m"
        yield from self._log("goal", f"{text} {logged}", text, logged)

    def _command(self, command: CmdVel, _at: int, _logged: int) -> Iterator[tuple[str, Any]]:
        yield "/cmd_vel", numbers.of_command(command)

    def _drive(self, drive: Drive, _at: int, _logged: int) -> Iterator[tuple[str, Any]]:
        yield "/drive", numbers.of_command(drive)

    def _plan(self, plan: Plan, ns: int, _: int) -> Iterator[tuple[str, Any]]:
        yield "/plan", SceneUpdate(entities=[shapes.plan_entity(plan, ns)])
        yield "/plan/obstacles", shapes.obstacle_points(plan, ns)

    def _preference(self, preference: Preference, ns: int, _: int) -> Iterator[tuple[str, Any]]:
        yield "/preference", shapes.preference_grid(preference, ns)

    def _map(self, grown: Map, ns: int, _: int) -> Iterator[tuple[str, Any]]:
        yield "/map", shapes.grown_map(grown, ns)

    def _learned_field(self, field: LearnedField, _: int, logged: int) -> Iterator[tuple[str, Any]]:
        text = f"uses version {field.version} of its field, learned while driving"
        yield from self._log("estimator", str(field.version), text, logged, topic="field")

    def _status(self, status: Status, _: int, logged: int) -> Iterator[tuple[str, Any]]:
        yield "/status", numbers.of_status(status)
        text = f"{status.state}: {status.reason}" if status.reason else status.state
        # One line for each change of state: the reason may contain numbers that always change.
        yield from self._log("controller", status.state, text, logged)

    def _health(self, health: Health, _: int, logged: int) -> Iterator[tuple[str, Any]]:
        yield f"/health/{health.service}", numbers.of_health(health)
        if health.note or health.service in self._last_log:
            text = health.note or "the problem is over"
            yield from self._log(health.service, health.note, text, logged, warn=bool(health.note), topic="health")

    def _log(
        self, name: str, key: str, text: str, ns: int, *, warn: bool | None = None, topic: str = ""
    ) -> Iterator[tuple[str, Any]]:
        """Yields a log line if ``key`` differs from that of the last line of this name."""
        if self._last_log.get(topic + name) == key:
            return
        self._last_log[topic + name] = key
        level = Log.WARNING if (key in WARNING_STATES if warn is None else warn) else Log.INFO
        yield "/log", Log(timestamp=shapes.time_of(ns), level=level, message=text, name=name)

    def _transforms(self, parent: str, child: str, pose: Array, ns: int) -> tuple[str, FrameTransforms]:
        """Updates one transform; returns all known transforms, each with the time of its own measurement."""
        self._chain[child] = (parent, pose, ns)
        links = [shapes.transform(start, end, pose, ns) for end, (start, pose, ns) in self._chain.items()]
        return "/tf", FrameTransforms(transforms=links)

    def _correction(self, pose: Array, stamp: int, ns: int) -> tuple[str, FrameTransforms]:
        """Sets map → odom so that base_link has ``pose`` (3,) in map with the odometry of the same stamp."""
        self._source_pose = (stamp, pose)
        odom = self._odoms.get(stamp)
        if odom is None:
            odom = next(reversed(self._odoms.values()), None)
        if odom is None:  # without odometry, map and odom are the same frame
            self._chain["odom"] = ("map", np.zeros(3), ns)
            return self._transforms("odom", "base_link", pose, ns)
        correction = compose(pose, between(odom, np.zeros(3)))
        return self._transforms("map", "odom", correction, ns)


def static_messages(
    world: World | None, robot: Robot, believed: Array, true: Array, ns: int
) -> Iterator[FoxgloveMessage]:
    """Yields what is shown from the beginning: map, walls, the robot's body, and the whole paths (N, 3) in map."""
    if world is not None:
        yield FoxgloveMessage("/map", shapes.grid(world, ns), ns, ns)
        yield FoxgloveMessage("/world", SceneUpdate(entities=shapes.world_entities(world, ns)), ns, ns)
    body = shapes.disc("base_link", "robot", np.zeros(3), robot.radius, 0.25, shapes.BELIEF, 0.4, ns)
    yield FoxgloveMessage("/robot", SceneUpdate(entities=[body]), ns, ns)
    paths = (("believed path", believed, shapes.BELIEF), ("true path", true, shapes.TRUTH))
    drawn = [shapes.path_entity(name, path, rgb, ns) for name, path, rgb in paths if len(path) > 1]
    if drawn:
        yield FoxgloveMessage("/paths", SceneUpdate(entities=drawn), ns, ns)
