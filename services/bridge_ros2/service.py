"""The process: two zenoh sessions."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, ClassVar

from common.bus.inbox import Sample
from common.geometry.rasterize import rasterise
from common.geometry.se2 import Array
from common.geometry.world import load_world
from common.messages.definitions import Belief, CmdVel, Goal, Stamped
from common.messages.requests import LocaliseRequest, Reply
from common.messages.ros_messages import stamp_of
from common.messages.topics import BELIEF, CMD_VEL, GOAL, LOCALISE, ODOM, SCAN, STATUS, Query, Topic
from common.runtime.service import Service
from services.bridge_ros2 import to_ros
from services.bridge_ros2.command_gate import CommandGate
from services.bridge_ros2.diagnostics import SCAN_TIMEOUT_S, diagnose
from services.bridge_ros2.from_ros import dead_reckoning_of, odom_of, pose_of, scan_of
from services.bridge_ros2.graph import Graph
from services.bridge_ros2.keys import KEPT, LATEST, SENSOR, TF, TF_STATIC, Qos
from services.bridge_ros2.odometry import MountAndOdometry, NoMountError
from services.bridge_ros2.ros_session import RosPublisher, RosSession, open_ros_session
from services.bridge_ros2.ros_types import (
    LASER_SCAN,
    OCCUPANCY_GRID,
    ODOMETRY,
    POSE_ARRAY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    TF_MESSAGE,
    TWIST,
    TWIST_STAMPED,
    CdrError,
    decode,
)  # fmt: skip
from services.bridge_ros2.settings import BridgeRos2Settings

MAP_PERIOD_S = 10.0  # s between two messages of the map, for who has missed it; SLAM's nodes say theirs as often
CHECK_PERIOD_S = 1.0  # s between two looks at how things stand, and between two tries to reach the router
YAW_TOLERANCE = 0.25  # rad, of rviz's goals, as nav2 has it


class BridgeRos2Service(Service):
    """A robot in ROS as a process of ours."""

    name: ClassVar[str] = "bridge_ros2"
    single: ClassVar[bool] = True
    serves_latched: ClassVar[tuple[Topic, ...]] = (GOAL, STATUS)
    inputs: ClassVar[tuple[Topic, ...]] = (BELIEF, CMD_VEL)

    def __init__(self, settings: BridgeRos2Settings) -> None:
        """Nothing is reached yet."""
        super().__init__(settings)
        self.options = settings
        self.graph = Graph(settings.names())
        self.motion = MountAndOdometry(settings.base_frame, settings.odom_frame, settings.the_mount())
        self.gate = CommandGate(settings.build_robot(), obstacle_stop=settings.obstacle_stop)
        self.blind = settings.build_self_filter()
        self.note = f"waits for the zenoh router at {settings.ros_connect}"
        self._ros: RosSession | None = None
        self._out: dict[str, RosPublisher] = {}
        self._rows: dict[str, tuple[str, Callable[[Any], None]]] = {}  # by name of our row: type, what is done
        self._look_at = 0.0
        self._scan_at: float | None = None  # when the last scan was passed on
        self._began = time.monotonic()
        self._clock: tuple[int, float] | None = None  # the robot's, and ours, when its last scan came
        self._waiting_said = False
        self._unplaced_said = False
        self._reckoned = False  # the last scan came with odometry
        self._map: Any = None  # the message
        self._map_at = 0.0  # when it is due
        self._problem = ""  # why the last message could not be used

    def open(self) -> None:
        """Declared before anybody asks: the first message on a key just declared may be lost."""
        self.options.check()
        if self.options.publish_map:
            self._map = to_ros.map_message(rasterise(load_world(self.options.world)), self.options.map_frame)
        for topic in (ODOM, SCAN):
            self.loop.bus.publisher(topic, self.name)

    def close(self) -> None:
        """A robot under way is stopped."""
        self._drive(self.gate.stop_for_silence(time.monotonic()))
        if self._ros is not None:
            self._ros.close()

    def _connect(self) -> None:
        """Reach the robot's router, or try again a second later."""
        options = self.options
        session = open_ros_session(options.ros_connect, options.ros_config)
        if session is None:
            if not self._waiting_said:
                self.log.warning(self.note)
            self._waiting_said = True
            return
        ros = self._ros = RosSession(session, options.names(), options.namespace, options.node, self.graph)
        self._began = time.monotonic()
        heard: list[tuple[str, str, Qos, Callable[[Any], None]]] = [
            (options.tf_topic + "_static", TF_MESSAGE, TF_STATIC, self._on_tf),
            (options.tf_topic, TF_MESSAGE, TF, self._on_tf),
            (options.odom_topic, ODOMETRY, Qos(), self._on_odometry),
            (options.scan_topic, LASER_SCAN, SENSOR, self._on_scan),
            (options.initial_pose_topic, POSE_WITH_COVARIANCE, Qos(), self._on_initial_pose),
        ]
        said = [
            (options.pose_topic, POSE_WITH_COVARIANCE, KEPT),
            (options.hypotheses_topic, POSE_ARRAY, SENSOR),
            (options.tf_topic if options.tf != "none" else "", TF_MESSAGE, TF),
        ]
        if self._map is not None:
            said.append((options.map_topic, OCCUPANCY_GRID, KEPT))
        if options.commands:
            heard.append((options.goal_topic, POSE_STAMPED, Qos(), self._on_goal))
            said.append((options.cmd_topic, TWIST_STAMPED if options.stamped else TWIST, LATEST))
        self._out = {name: ros.publisher(options.topic(name), kind, qos) for name, kind, qos in said if name}
        for name, kind, qos, hear in heard:
            if name:
                row = _row(name, newest=name == options.scan_topic)
                self._rows[row.name] = (kind, hear)
                ros.subscribe(row, options.topic(name), kind, qos, self.loop.inbox)
        self.note = f"no scan on {options.topic(options.scan_topic)} yet"
        self.log.info("reached the robot's side", endpoint=options.ros_connect, flavor=options.flavor)

    def due(self) -> float | None:
        """Until the next look, or until a robot whose commands have ended is stopped."""
        now = time.monotonic()
        stop = self.gate.due(now) if self.gate.moving else self.gate.repeat_due(now)
        look = self._look_at - now
        return look if stop is None else min(look, stop)

    def on_timer(self) -> None:
        """Stop the robot; look how things stand."""
        now = time.monotonic()
        if self.gate.moving and self.gate.due(now) <= 0:
            self.counters["stops_for_silence"] += 1
            self.log.warning("stop: commands have ended", silent_s=round(self.gate.timeout, 2))
            self._drive(self.gate.stop_for_silence(now))
        self._drive(self.gate.repeat_stop(now))
        if now >= self._look_at:
            self._look_at = now + CHECK_PERIOD_S
            self._look(now)

    def _look(self, now: float) -> None:
        """Say in health, and once in the log, what is missing."""
        if self._ros is None:
            self._connect()
            self._look_at = time.monotonic() + CHECK_PERIOD_S
        before = self.note
        if self._ros is not None:
            self._say_map(now)
            static = self.options.topic(self.options.tf_topic + "_static")
            if self.motion.mount() is None:
                self._ros.fetch(_row(self.options.tf_topic + "_static"), static, self.loop.inbox)
            since = self._scan_at if self._scan_at is not None else self._began
            self.note = diagnose(
                self.options, self.graph, self._problem,
                linked=self._ros.linked(), quiet=now - since, heard=self._scan_at is not None,
                reckoned=self._reckoned,
            )  # fmt: skip
            self._say_unplaced(now)
        if self.note and self.note != before:
            self.log.warning(self.note)
        elif before and not self.note:
            self.log.info("scans come", mount=self.motion.mount())

    def _say_unplaced(self, now: float) -> None:
        """Once: odometry is about a frame that tf does not know, though it had the time to come."""
        child, base = self.motion.unconnected_frame, self.motion.base
        if child and not self._unplaced_said and now - self._began > SCAN_TIMEOUT_S:
            self._unplaced_said = True
            self.log.warning(
                "odometry is about a frame that tf does not connect with the base: taken for the base's",
                frame=child,
                base=base,
            )

    def on_sample(self, sample: Sample) -> None:
        """Ours as ever; one of ROS is decoded, and handed to what is done with its topic."""
        if sample.topic.name not in self._rows:
            super().on_sample(sample)
            return
        kind, hear = self._rows[sample.topic.name]
        try:
            self.options.names().check_type_hash(sample.key, kind)
            hear(decode(kind, sample.payload))
        except NoMountError as error:  # tf may still be on its way: after a while it is said
            self._problem = str(error)
            self.counters["scans_without_mount"] += 1
        except (CdrError, ValueError, OverflowError) as error:
            self._problem = str(error) if sample.topic == _row(self.options.scan_topic, newest=True) else self._problem
            self.loop.reject(sample.key, str(error))

    def _on_tf(self, message: Any) -> None:
        self.motion.add_tf(message)

    def _on_odometry(self, message: Any) -> None:
        child = self.motion.child_in_base(message.child_frame_id)
        dead = dead_reckoning_of(message, child)
        self.motion.add_odometry(dead)
        self.gate.add_velocity(dead.twist, time.monotonic())

    def _on_scan(self, message: Any) -> None:
        """The scan, after the odometry of its moment."""
        now = time.monotonic()
        stamp_ns = stamp_of(message.header)
        if stamp_ns <= 0:
            stamp_ns = time.time_ns()
            self.counters["scans_without_stamp"] += 1
        mount = self.motion.mount_for(message.header.frame_id)
        scan = scan_of(message, mount, stamp_ns)
        self._clock = (stamp_ns, now)
        dead = self.motion.at(stamp_ns)
        self._reckoned = dead is not None
        if dead is not None:
            self.publish(ODOM, odom_of(dead))
        else:
            self.counters["scans_without_odometry"] += 1
        self.gate.add_scan(self.blind.mask_for_planning(scan), now)
        self.publish(SCAN, self.blind.mask_for_bus(scan))
        self._scan_at, self._problem = now, ""

    def _on_initial_pose(self, message: Any) -> None:
        pose = pose_of(message, self.options.map_frame)
        self.log.info("told where the robot is", x=pose.x, y=pose.y, yaw=pose.yaw)
        self.request(LOCALISE, LocaliseRequest(pose=pose))

    def _on_goal(self, message: Any) -> None:
        pose = pose_of(message, self.options.map_frame)
        self.log.info("goal", x=pose.x, y=pose.y, yaw=pose.yaw)
        stamp_ns = self._clock[0] if self._clock else 0
        self.publish(GOAL, Goal(stamp_ns=stamp_ns, pose=pose, yaw_tolerance=YAW_TOLERANCE))

    def on_reply(self, query: Query, number: int, reply: Reply) -> None:  # noqa: ARG002
        """What became of rviz's pose."""
        if not reply.ok:
            self.log.warning("the estimator was not told where the robot is", why=reply.reason)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """A belief or a command, for ROS."""
        if isinstance(message, Belief):
            self._say(message)
        elif isinstance(message, CmdVel) and self.options.commands:
            refused = self.gate.refused
            self._drive(self.gate.command(message, time.monotonic()))
            if self.gate.refused > refused:
                self.counters["stale_commands"] += 1

    def _say(self, belief: Belief) -> None:
        """Pose, transform and hypotheses."""
        options = self.options
        if (cloud := self._out.get(options.hypotheses_topic)) is not None:
            cloud.put(to_ros.hypotheses_message(belief, options.map_frame))
        if not to_ros.is_publishable(belief):
            self.counters["beliefs_not_said"] += 1
            return
        if (pose := self._out.get(options.pose_topic)) is not None:
            message = to_ros.pose_message(belief, options.map_frame)
            if message is not None:
                pose.put(message)
        if (tf := self._out.get(options.tf_topic)) is not None:
            self._say_transform(belief, tf)

    def _say_transform(self, belief: Belief, tf: RosPublisher) -> None:
        options, odometry, child = self.options, None, self.options.base_frame
        if options.tf == "map-odom":
            dead = self.motion.at_by_tf(belief.stamp_ns)
            if dead is None:
                self.counters["transforms_without_odometry"] += 1
                return
            odometry, child = dead.pose, options.odom_frame
        ahead = belief.stamp_ns + round(options.transform_tolerance * 1e9)
        pose = to_ros.correction(belief.pose, odometry)
        tf.put(to_ros.transform_message(pose, ahead, options.map_frame, child))

    def _say_map(self, now: float) -> None:
        """Kept for those who come later, as map_server's; and again, for those whom that does not reach."""
        if self._map is not None and now >= self._map_at:
            self._map_at = now + MAP_PERIOD_S
            self._out[self.options.map_topic].put(self._map)

    def _drive(self, twist: Array | None) -> None:
        """Send a velocity, dated by the robot's clock."""
        publisher = self._out.get(self.options.cmd_topic)
        if twist is None or publisher is None:
            return
        stamp = None
        if self.options.stamped:
            there, here = self._clock or (time.time_ns(), time.monotonic())
            stamp = there + round((time.monotonic() - here) * 1e9)
        kind, message = to_ros.twist_message(twist, stamp, self.options.base_frame)
        publisher.put(message, kind)


def _row(name: str, *, newest: bool = False) -> Topic:
    """A topic of ROS as the inbox has it."""
    return Topic(
        f"ros {name}", Stamped, "ros", 0, "newest" if newest else "all", recorded=False, multiple_publishers=True
    )
