"""The bridge as a process; the test is estimator and controller on one side, robot and rviz on the other."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
import pytest
import zenoh
import zenoh.ext

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Inbox, Sample
from common.geometry import se2
from common.geometry.rasterisation import rasterise
from common.geometry.world import load_world
from common.messages.definitions import Goal, Health, Odom, Scan
from common.messages.requests import LocaliseRequest, Reply
from common.messages.topics import BELIEF, CMD_VEL, GOAL, HEALTH, LOCALISE, ODOM, SCAN
from tests.bridge_ros2 import cdr
from tests.bridge_ros2.messages import belief
from tests.conftest import WAIT_TIMEOUT_S
from tests.system.ros2_robot import BEGIN, Ros, transform, transforms

LASER, ODOMETRY = "sensor_msgs::msg::dds_::LaserScan_", "nav_msgs::msg::dds_::Odometry_"
POSED, TF = "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_", "tf2_msgs::msg::dds_::TFMessage_"
TWIST, GOAL_POSE = "geometry_msgs::msg::dds_::Twist_", "geometry_msgs::msg::dds_::PoseStamped_"


RANGES = [1.0, 2.0, 3.0, 0.0, 5.0]


def odometry(stamp_ns):
    return cdr.odometry(stamp_ns, cdr.planar_pose(2.0, 0.0), (0.5, 0.0, 0.0))


class Beside:
    """Both sides of the bridge: presage's bus and a node in ROS."""

    def __init__(self, bus, node) -> None:
        self.bus, self.node, self.stamp = bus, node, BEGIN
        self.inbox, self.calls, self.kept = Inbox(), Inbox(), deque(maxlen=100)
        self.heard = {"amcl_pose": [], "tf": [], "cmd_vel": []}
        for topic in (SCAN, ODOM, GOAL, HEALTH):
            bus.subscribe(topic, self.inbox, keep_all=True)
        bus.serve(LOCALISE, self.calls)
        for name, kind in (("amcl_pose", POSED), ("tf", TF), ("cmd_vel", TWIST)):
            node.subscribe(name, kind, self.heard[name].append)
        kinds = {"tf_static": TF, "scan": LASER, "odom": ODOMETRY, "initialpose": POSED, "goal_pose": GOAL_POSE}
        self.put = {name: node.publisher(name, kind) for name, kind in kinds.items()}
        # Published before the bridge starts.
        self.put["tf_static"](transforms(transform("base_link", "laser", 0.3, 0, 0, cdr.quaternion(), 0)))

    def sweep(self):
        """Publishes odometry and, 50 ms later by its stamp, a scan. Returns the bridge's Odom and Scan."""
        self.stamp += 10**8
        self.put["odom"](odometry(self.stamp - 5 * 10**7))
        self.put["scan"](cdr.laser_scan(self.stamp, RANGES))
        return tuple(self.next(kind, lambda each: each.stamp_ns == self.stamp) for kind in (Odom, Scan))

    def next(self, kind, condition=lambda _: True):
        """The next message of a type that meets a condition. Keeps the others, because topics arrive interleaved."""
        found = []

        def look():
            while isinstance(sample := self.inbox.get(0), Sample):
                self.kept.append(sample.topic.message.decode(sample.payload))
            found.extend(each for each in self.kept if isinstance(each, kind) and condition(each))
            return bool(found)

        assert wait_until(look, WAIT_TIMEOUT_S), f"no such {kind.__name__}"
        return found[-1]

    def counts(self, counter, at_least):
        self.next(Health, lambda each: each.service == "bridge_ros2" and each.counters.get(counter, 0) >= at_least)

    def believe(self, state):
        self.sweep()
        self.bus.put(BELIEF, belief(state, stamp_ns=self.stamp).encode())


@pytest.fixture(scope="module")
def beside(module_processes, router):
    """A bridge between both sides, which here share one router."""
    link = Link(robot="rover", connect=(f"tcp/127.0.0.1:{router}",))
    with open_bus(link) as bus, Ros(router, "rmw_zenoh", "jazzy") as node:
        found = Beside(bus, node)
        environment = {"PRESAGE_CONNECT": link.connect[0], "PRESAGE_ROBOT": "rover"}
        args = ("--ros-connect", f"tcp/127.0.0.1:{router}", "--publish-map", "--world", "maze")
        bridge = module_processes.start("bridge_ros2", *args, env=environment)
        bridge.wait_for("ready")
        assert bus.wait_matching(BELIEF, WAIT_TIMEOUT_S)
        assert bus.wait_matching(CMD_VEL, WAIT_TIMEOUT_S)
        last = time.monotonic()

        def heard():  # the first messages may be sent before the bridge's subscription is known
            nonlocal last
            if time.monotonic() - last > 0.2:
                last, found.stamp = time.monotonic(), found.stamp + 10**8
                found.put["odom"](odometry(found.stamp))
                found.put["scan"](cdr.laser_scan(found.stamp, RANGES))
            return all(found.inbox.received[topic.key("rover")] > 0 for topic in (SCAN, ODOM))

        assert wait_until(heard, WAIT_TIMEOUT_S), bridge.output
        yield found
        assert bridge.stop() == 0


def test_published_beliefs(beside):
    for number, state in enumerate(("localising", "ambiguous", "lost"), 1):
        beside.believe(state)
        beside.counts("beliefs_not_published", number)  # one by one, as a busy bridge only takes the newest
    assert not beside.heard["amcl_pose"]
    assert not beside.heard["tf"]
    beside.believe("tracking")
    assert wait_until(lambda: bool(beside.heard["amcl_pose"] and beside.heard["tf"]), WAIT_TIMEOUT_S)
    pose, (published,) = beside.heard["amcl_pose"][-1], beside.heard["tf"][-1].transforms
    assert pose.pose.covariance[35] == 0.09
    assert (published.header.frame_id, published.child_frame_id) == ("map", "odom")
    at, turn = published.transform.translation, published.transform.rotation
    odom_in_map = [at.x, at.y, 2 * np.arctan2(turn.z, turn.w)]
    np.testing.assert_allclose(se2.compose(odom_in_map, [2.025, 0, 0]), [3.0, -1.5, 0.5], atol=1e-9)
    stamps = [each.stamp.sec * 10**9 + each.stamp.nanosec for each in (pose.header, published.header)]
    assert stamps == [beside.stamp, beside.stamp + 10**9]  # the transform is stamped ahead, as in AMCL


def test_buttons_of_rviz(beside):
    posed = {"pose": cdr.planar_pose(4, 2), "covariance": [0.0] * 36}
    message = {"header": cdr.header(0, "map"), "pose": posed}
    beside.put["initialpose"](cdr.encode("geometry_msgs/msg/PoseWithCovarianceStamped", message))
    calls = []
    assert wait_until(lambda: (call := beside.calls.get(0)) is not None and not calls.append(call), WAIT_TIMEOUT_S)
    request = LocaliseRequest.decode(calls[0].payload)
    assert (request.pose.x, request.pose.y) == (4, 2)
    calls[0].reply(Reply().encode())
    beside.put["goal_pose"](cdr.pose_stamped(cdr.planar_pose(9, 9), "odom"))  # in the wrong frame: rejected
    beside.put["goal_pose"](cdr.pose_stamped(cdr.planar_pose(5, 1), "map"))
    goal = beside.next(Goal)
    assert (goal.pose.x, goal.pose.y, goal.seq) == (5, 1, 0)


def test_map_for_late_subscribers(beside):
    """A late subscriber requests the history, as rmw_zenoh does for transient-local topics, and gets it at once."""
    key = "0/map/nav_msgs::msg::dds_::OccupancyGrid_/*"

    def ask():
        """The first map with history requested, and whether the bridge happened to repeat the map at that time."""
        heard, again = [], []
        plain = beside.node.session.declare_subscriber(key, again.append)
        late = zenoh.ext.declare_advanced_subscriber(
            beside.node.session, key, heard.append,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )  # fmt: skip
        try:
            assert wait_until(lambda: bool(heard), WAIT_TIMEOUT_S)
            return heard, bool(again)
        finally:
            late.undeclare()
            plain.undeclare()

    heard, again = ask()
    if again:  # the next repetition is far off
        heard, again = ask()
    assert not again
    sample = heard[0]
    assert len(sample.attachment.to_bytes()) == 33
    published = cdr.decode("nav_msgs/msg/OccupancyGrid", sample.payload.to_bytes())
    grid = rasterise(load_world("maze"))
    assert (published.info.width, published.info.height, published.header.frame_id) == (grid.width, grid.height, "map")
    np.testing.assert_array_equal(np.array(published.data, np.int8).view(np.uint8), grid.values.ravel())
    tokens = beside.node.session.liveliness().get("@ros2_lv/0/**")
    (token,) = [str(reply.ok.key_expr) for reply in tokens if reply.ok and "/%map/" in str(reply.ok.key_expr)]
    assert token.endswith("/:1:,1:,:,:,,")


def test_reported_problems(processes, router):
    ours = {"PRESAGE_CONNECT": f"tcp/127.0.0.1:{router}", "PRESAGE_ROBOT": "lost"}
    theirs, port = processes.start_router()
    nowhere = processes.start(
        "bridge_ros2", "--ros-connect", "tcp/127.0.0.1:1", env=ours
    )  # nothing listens on this port
    wrong = {**ours, "PRESAGE_ROBOT": "wrong"}
    bridge = processes.start("bridge_ros2", "--ros-connect", f"tcp/127.0.0.1:{port}", env=wrong)
    with Ros(port, "rmw_zenoh", "jazzy") as node:
        node.publisher("scan_raw", LASER)
        nowhere.wait_for("waiting for the zenoh router at tcp/127.0.0.1:1")
        bridge.wait_for("no node publishes it; set --scan-topic: sensor_msgs/msg/LaserScan is published on /scan_raw")
        put, last = node.publisher("scan", LASER), [0.0]

        def complains_about_tf():
            if time.monotonic() - last[0] > 0.2:
                last[0] = time.monotonic()
                put(cdr.laser_scan(BEGIN, RANGES, "lidar"))
            return "tf does not connect lidar with base_link" in bridge.output

        assert wait_until(complains_about_tf, WAIT_TIMEOUT_S), bridge.output
    theirs.kill()
    bridge.wait_for("the connection is lost")
    assert nowhere.stop() == bridge.stop() == 0
