"""The ROS 2 bridge between real processes: a simulated ROS 2 robot, and presage's estimator and controller."""

from __future__ import annotations

import json
import math

import pytest

from common.bus.bus import Link, open_bus, wait_until
from common.geometry import se2
from common.messages.definitions import Goal, Pose
from common.messages.topics import GOAL
from tests.bridge_ros2.cdr import planar_pose, pose_stamped
from tests.conftest import WAIT_TIMEOUT_S
from tests.system.ros2_robot import Ros

GOAL_POSE = "geometry_msgs::msg::dds_::PoseStamped_"


def last_report(robot):
    """The last state that the simulated robot printed."""
    lines = [line for line in robot.output.splitlines() if line.startswith("{") and line.endswith("}")]
    return json.loads(lines[-1]) if lines else {}


def wait_until_report(robot, condition, what, *others):
    if not wait_until(lambda: bool(now := last_report(robot)) and condition(now), WAIT_TIMEOUT_S):
        pytest.fail(f"{what}: {last_report(robot)}\n" + "\n".join(each.output[-3000:] for each in (robot, *others)))


def assert_no_errors(robot):
    """Checks for errors in zenoh callbacks, which zenoh does not report, such as an invalid attachment."""
    assert robot.running
    assert "Error" not in robot.output
    assert not last_report(robot)["contact"]


def arrived(now):
    """Whether the robot stands at the goal, with the right pose in ROS and a tf that corrects the odometry's drift."""
    believed, by_tf = now["pose"][:2], se2.compose(now["odom_in_map"], now["odom"])[:2]
    there = math.dist(now["truth"][:2], (4.2, 1.5)) < 0.25 and now["speed"] < 0.01
    return there and math.dist(believed, now["truth"][:2]) < 0.05 and math.dist(by_tf, now["truth"][:2]) < 0.05


@pytest.fixture(scope="module")
def services(module_processes):
    """Estimator and controller, which take seconds to start, on one router; the robot uses a second router."""
    port, ros = module_processes.start_router()[1], module_processes.start_router()[1]
    environment = {"PRESAGE_CONNECT": f"tcp/127.0.0.1:{port}", "PRESAGE_ROBOT": "rover", "OMP_NUM_THREADS": "1"}

    def start(name, *args):
        return module_processes.start(name, *args, env=environment)

    start("estimator")
    controller = start("controller")
    link = Link(robot="rover", connect=(environment["PRESAGE_CONNECT"],))
    with open_bus(link) as bus:
        assert wait_until(lambda: {"estimator", "controller"} <= bus.alive(timeout=0.5), 60)
        yield start, bus, ros, controller


def test_rmw_zenoh_robot(services):
    start, _, port, _ = services
    bridge = start("bridge_ros2", "--ros-connect", f"tcp/127.0.0.1:{port}")
    robot = start("tests.system.ros2_robot", "--port", str(port))
    wait_until_report(robot, lambda now: now["pose"] and now["transforms"] > 3, "no pose and transform", bridge)
    with Ros(port, "rmw_zenoh", "jazzy") as rviz:
        put = rviz.publisher("goal_pose", GOAL_POSE)
        assert wait_until(lambda: bool(rviz.kept[-1].matching_status.matching), WAIT_TIMEOUT_S)
        put(pose_stamped(planar_pose(4.2, 1.5), "map"))
        wait_until_report(robot, arrived, "no way", bridge)
        put(pose_stamped(planar_pose(12.0, 1.5), "map"))
        wait_until_report(robot, lambda now: now["speed"] > 0.3, "it does not go on", bridge)
    bridge.kill()
    wait_until_report(robot, lambda now: now["speed"] < 0.01, "it drives on without the bridge")
    zeros = last_report(robot)["zeros"]
    bridge = start("bridge_ros2", "--ros-connect", f"tcp/127.0.0.1:{port}")
    wait_until_report(robot, lambda now: now["speed"] > 0.3, "it does not go on with another bridge", bridge)
    assert bridge.stop() == 0
    wait_until_report(robot, lambda now: now["zeros"] > zeros, "a bridge that ends sends no stop", bridge)
    assert_no_errors(robot)
    robot.stop()


def test_ros2dds_robot(services):
    start, bus, port, controller = services
    bridge = start("bridge_ros2", "--ros-connect", f"tcp/127.0.0.1:{port}", "--flavor", "ros2dds", "--stamped")
    robot = start("tests.system.ros2_robot", "--port", str(port), "--flavor", "ros2dds", "--stamped")
    wait_until_report(robot, lambda now: now["pose"] and now["transforms"] > 3, "no pose and transform", bridge)
    assert bus.wait_matching(GOAL, WAIT_TIMEOUT_S)
    bus.put(GOAL, Goal(stamp_ns=0, pose=Pose(x=12.0, y=1.5)).encode())
    wait_until_report(robot, lambda now: now["speed"] > 0.3, "it does not go", bridge)
    controller.kill()
    wait_until_report(robot, lambda now: now["zeros"] > 0, "no stop", bridge)
    bridge.wait_for("stop: commands have ended")
    wait_until_report(robot, lambda now: now["speed"] < 0.01, "it does not stand")
    assert_no_errors(robot)
    robot.stop()
    assert bridge.stop() == 0
