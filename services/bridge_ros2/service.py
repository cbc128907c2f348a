"""The bridge service, with one zenoh session for presage and one for ROS."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, ClassVar

from common.bus.inbox import Sample
from common.geometry.rasterisation import rasterise
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
from services.bridge_ros2.graph import RosGraph
from services.bridge_ros2.keys import LATCHED_QOS, LATEST_QOS, SENSOR_QOS, TF_QOS, TF_STATIC_QOS, Qos
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
)
from services.bridge_ros2.settings import (
    GOAL_TOPIC,
    HYPOTHESES_TOPIC,
    INITIAL_POSE_TOPIC,
    MAP_FRAME,
    MAP_TOPIC,
    NODE,
    POSE_TOPIC,
    TF_TOPIC,
    TRANSFORM_TOLERANCE_S,
    BridgeRos2Settings,
)

MAP_PERIOD_S = 10.0  # the map is repeated for subscribers that missed it, as SLAM nodes do
CHECK_PERIOD_S = 1.0  # between checks of the health, and between attempts to reach the router
YAW_TOLERANCE_RAD = 0.25  # of goals from rviz, as in nav2


class BridgeRos2Service(Service):
    """Connects presage with a robot in ROS 2."""

    name: ClassVar[str] = "bridge_ros2"
    single: ClassVar[bool] = True
    serves_latched: ClassVar[tuple[Topic, ...]] = (GOAL, STATUS)
    inputs: ClassVar[tuple[Topic, ...]] = (BELIEF, CMD_VEL)

    def __init__(self, settings: BridgeRos2Settings) -> None:
        super().__init__(settings)
        self.options = settings
        self.graph = RosGraph(settings.ros_keys())
        self.motion = MountAndOdometry(settings.base_frame, settings.odom_frame, settings.build_mount())
        self.self_filter = settings.build_self_filter()
        self.gate = CommandGate(settings.build_robot(), self.self_filter, obstacle_stop=settings.obstacle_stop)
        self.note, self.idle = f"waiting for the zenoh router at {settings.ros_endpoint}", True
        self._ros: RosSession | None = None
        self._publishers: dict[str, RosPublisher] = {}  # by the option's topic name
        # Message type and handler of each subscribed ROS topic, by the name of its inbox topic.
        self._handlers: dict[str, tuple[str, Callable[[Any], None]]] = {}
        self._check_at = 0.0
        self._scan_at: float | None = None  # when the last scan was passed on
        self._began = time.monotonic()
        self._clock: tuple[int, float] | None = None  # the last scan's stamp, and its monotonic reception time
        self._warned_waiting = False
        self._warned_unconnected_frame = False
        self._with_odometry = False  # the last scan had odometry for its stamp
        self._map: Any = None  # the map message
        self._map_at = 0.0  # when the map is published next
        self._problem = ""  # why the last scan could not be used

    def open(self) -> None:
        """Checks the settings and declares publishers, because the first messages after a declaration may be lost."""
        self.options.check()
        if self.options.publish_map:
            self._map = to_ros.map_message(rasterise(load_world(self.options.world)), MAP_FRAME)
        for topic in (ODOM, SCAN):
            self.loop.bus.publisher(topic, self.name)

    def close(self) -> None:
        """Stops a moving robot, as often as after commands have ended, and closes the session on the ROS side."""
        self._drive(self.gate.stop_for_silence(time.monotonic()))
        while (due := self.gate.repeat_due(time.monotonic())) is not None:
            time.sleep(max(0.0, due))
            self._drive(self.gate.repeat_stop(time.monotonic()))
        if self._ros is not None:
            self._ros.close()

    def _connect(self) -> None:
        """Tries to reach the robot's router. If it answers, declares subscriptions and publishers."""
        options = self.options
        session = open_ros_session(options.ros_connect, options.ros_config)
        if session is None:
            if not self._warned_waiting:
                self.log.warning(self.note)
            self._warned_waiting = True
            return
        ros = self._ros = RosSession(session, options.ros_keys(), options.namespace, NODE, self.graph)
        self._began = time.monotonic()
        subscribed: list[tuple[str, str, Qos, Callable[[Any], None]]] = [
            (TF_TOPIC + "_static", TF_MESSAGE, TF_STATIC_QOS, self._on_tf),
            (TF_TOPIC, TF_MESSAGE, TF_QOS, self._on_tf),
            (options.odom_topic, ODOMETRY, Qos(), self._on_odometry),
            (options.scan_topic, LASER_SCAN, SENSOR_QOS, self._on_scan),
            (INITIAL_POSE_TOPIC, POSE_WITH_COVARIANCE, Qos(), self._on_initial_pose),
        ]
        published = [
            (POSE_TOPIC, POSE_WITH_COVARIANCE, LATCHED_QOS),
            (HYPOTHESES_TOPIC, POSE_ARRAY, SENSOR_QOS),
            (TF_TOPIC if options.tf != "none" else "", TF_MESSAGE, TF_QOS),
        ]
        if self._map is not None:
            published.append((MAP_TOPIC, OCCUPANCY_GRID, LATCHED_QOS))
        if options.commands:
            subscribed.append((GOAL_TOPIC, POSE_STAMPED, Qos(), self._on_goal))
            published.append((options.cmd_topic, TWIST_STAMPED if options.stamped else TWIST, LATEST_QOS))
        self._publishers = {
            name: ros.publisher(options.topic(name), kind, qos) for name, kind, qos in published if name
        }
        for name, kind, qos, handler in subscribed:
            if name:
                inbox_topic = _inbox_topic(name, newest=name == options.scan_topic)
                self._handlers[inbox_topic.name] = (kind, handler)
                ros.subscribe(inbox_topic, options.topic(name), kind, qos, self.loop.inbox)
        self.note = f"no scan on {options.topic(options.scan_topic)} yet"
        self.log.info("connected to the robot's router", endpoint=options.ros_endpoint, flavor=options.flavor)

    def due(self) -> float | None:
        """Seconds until the next check, or until a robot without commands is stopped."""
        now = time.monotonic()
        stop = self.gate.due(now) if self.gate.moving else self.gate.repeat_due(now)
        check = self._check_at - now
        return check if stop is None else min(check, stop)

    def on_timer(self) -> None:
        """Stops a robot without commands, and checks the health periodically."""
        now = time.monotonic()
        if self.gate.moving and self.gate.due(now) <= 0:
            self.counters["stops_for_silence"] += 1
            self.log.warning("stop: commands have ended", silent_s=round(self.gate.timeout, 2))
            self._drive(self.gate.stop_for_silence(now))
        self._drive(self.gate.repeat_stop(now))
        if now >= self._check_at:
            self._check_at = now + CHECK_PERIOD_S
            self._check(now)

    def _check(self, now: float) -> None:
        """Connects if necessary, publishes the map, and reports problems in the health note and once in the log."""
        if self._ros is None:
            self._connect()
            self._check_at = time.monotonic() + CHECK_PERIOD_S
        before = self.note
        linked = self._ros is not None and self._ros.linked()
        self.idle = not linked
        if self._ros is not None:
            self._publish_map(now)
            static = self.options.topic(TF_TOPIC + "_static")
            if self.motion.mount() is None:
                self._ros.fetch(_inbox_topic(TF_TOPIC + "_static"), static, self.loop.inbox)
            since = self._scan_at if self._scan_at is not None else self._began
            self.note = diagnose(
                self.options,
                self.graph,
                self._problem,
                linked=linked,
                scan_age=now - since,
                received=self._scan_at is not None,
                with_odometry=self._with_odometry,
            )
            self._warn_about_unconnected_frame(now)
        if self.note and self.note != before:
            self.log.warning(self.note)
        elif before and not self.note:
            self.log.info("receiving scans", mount=self.motion.mount())

    def _warn_about_unconnected_frame(self, now: float) -> None:
        """Logs once if tf does not contain the odometry's child frame, some time after the start."""
        child, base = self.motion.unconnected_frame, self.motion.base
        if child and not self._warned_unconnected_frame and now - self._began > SCAN_TIMEOUT_S:
            self._warned_unconnected_frame = True
            self.log.warning(
                "tf does not connect the child frame of the odometry with the base: it is taken for the base",
                frame=child,
                base=base,
            )

    def on_sample(self, sample: Sample) -> None:
        """Decodes a sample from ROS and calls its handler. Samples from the bus are handled by the base class."""
        if sample.topic.name not in self._handlers:
            super().on_sample(sample)
            return
        kind, handler = self._handlers[sample.topic.name]
        try:
            self.options.ros_keys().check_type_hash(sample.key, kind)
            handler(decode(kind, sample.payload))
        except NoMountError as error:  # tf may still arrive; the health note reports it only after a while
            self._problem = str(error)
            self.counters["scans_without_mount"] += 1
        except (CdrError, ValueError, OverflowError) as error:
            if sample.topic == _inbox_topic(self.options.scan_topic, newest=True):
                self._problem = str(error)
            self.loop.reject(sample.key, str(error))

    def _on_tf(self, message: Any) -> None:
        self.motion.add_tf(message)

    def _on_odometry(self, message: Any) -> None:
        child = self.motion.child_in_base(message.child_frame_id)
        odometry = dead_reckoning_of(message, child)
        self.motion.add_odometry(odometry)
        self.gate.add_velocity(odometry.twist, time.monotonic())

    def _on_scan(self, message: Any) -> None:
        """Publishes the odometry at the scan's stamp and then the scan."""
        now = time.monotonic()
        stamp_ns = stamp_of(message.header)
        if stamp_ns <= 0:
            stamp_ns = time.time_ns()
            self.counters["scans_without_stamp"] += 1
        mount = self.motion.mount_for(message.header.frame_id)
        scan = scan_of(message, mount, stamp_ns)
        self._clock = (stamp_ns, now)
        odometry = self.motion.at(stamp_ns)
        self._with_odometry = odometry is not None
        if odometry is not None:
            self.publish(ODOM, odom_of(odometry))
            self.gate.add_velocity(odometry.twist, now)  # also if the odometry comes in tf
        else:
            self.counters["scans_without_odometry"] += 1
        self.gate.add_scan(scan, now)
        self.publish(SCAN, self.self_filter.mask_for_bus(scan))
        self._scan_at, self._problem = now, ""

    def _on_initial_pose(self, message: Any) -> None:
        pose = pose_of(message, MAP_FRAME)
        self.log.info("initial pose from ROS", x=pose.x, y=pose.y, yaw=pose.yaw)
        self.send_request(LOCALISE, LocaliseRequest(pose=pose))

    def _on_goal(self, message: Any) -> None:
        pose = pose_of(message, MAP_FRAME)
        self.log.info("goal from ROS", x=pose.x, y=pose.y, yaw=pose.yaw)
        stamp_ns = self._clock[0] if self._clock else 0
        self.publish(GOAL, Goal(stamp_ns=stamp_ns, pose=pose, yaw_tolerance=YAW_TOLERANCE_RAD))

    def on_reply(self, query: Query, number: int, reply: Reply) -> None:  # noqa: ARG002
        """Logs if the estimator did not accept the initial pose."""
        if not reply.ok:
            self.log.warning("the estimator did not accept the initial pose", reason=reply.reason)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """Publishes a belief or a command to ROS."""
        if isinstance(message, Belief):
            self._publish_belief(message)
        elif isinstance(message, CmdVel) and self.options.commands:
            refused = self.gate.refused
            self._drive(self.gate.command(message, time.monotonic()))
            if self.gate.refused > refused:
                self.counters["stale_commands"] += 1

    def _publish_belief(self, belief: Belief) -> None:
        """Publishes hypotheses and, while the robot is tracked, pose and transform."""
        if (hypotheses := self._publishers.get(HYPOTHESES_TOPIC)) is not None:
            hypotheses.put(to_ros.hypotheses_message(belief, MAP_FRAME))
        if not to_ros.is_publishable(belief):
            self.counters["beliefs_not_published"] += 1
            return
        if (pose := self._publishers.get(POSE_TOPIC)) is not None:
            message = to_ros.pose_message(belief, MAP_FRAME)
            if message is not None:
                pose.put(message)
        if (tf := self._publishers.get(TF_TOPIC)) is not None:
            self._publish_transform(belief, tf)

    def _publish_transform(self, belief: Belief, tf: RosPublisher) -> None:
        options, odometry_pose, child = self.options, None, self.options.base_frame
        if options.tf == "map-odom":
            odometry = self.motion.at_by_tf(belief.stamp_ns)
            if odometry is None:
                self.counters["transforms_without_odometry"] += 1
                return
            odometry_pose, child = odometry.pose, options.odom_frame
        stamp_ns = belief.stamp_ns + round(TRANSFORM_TOLERANCE_S * 1e9)
        pose = to_ros.correction(belief.pose, odometry_pose)
        tf.put(to_ros.transform_message(pose, stamp_ns, MAP_FRAME, child))

    def _publish_map(self, now: float) -> None:
        """Publishes the map if it is due. It is latched, as map_server's, and repeated in case that fails."""
        if self._map is not None and now >= self._map_at:
            self._map_at = now + MAP_PERIOD_S
            self._publishers[MAP_TOPIC].put(self._map)

    def _drive(self, twist: Array | None) -> None:
        """Publishes a velocity, stamped with the robot's clock. Does nothing if ``twist`` is None."""
        publisher = self._publishers.get(self.options.cmd_topic)
        if twist is None or publisher is None:
            return
        stamp_ns = None
        if self.options.stamped:
            scan_stamp_ns, received_at = self._clock or (time.time_ns(), time.monotonic())
            stamp_ns = scan_stamp_ns + round((time.monotonic() - received_at) * 1e9)
        kind, message = to_ros.twist_message(twist, stamp_ns, self.options.base_frame)
        publisher.put(message, kind)


def _inbox_topic(name: str, *, newest: bool = False) -> Topic:
    """A `Topic` with which the inbox queues the messages of a ROS topic."""
    return Topic(
        f"ros {name}", Stamped, "ros", 0, "newest" if newest else "all", recorded=False, multiple_publishers=True
    )
