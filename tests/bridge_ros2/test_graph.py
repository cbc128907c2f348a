"""What is said where messages do not come."""

from __future__ import annotations

from services.bridge_ros2.complaints import complaint
from services.bridge_ros2.graph import Graph
from services.bridge_ros2.keys import Names, Node, Qos
from services.bridge_ros2.ros_types import LASER_SCAN, ODOMETRY, TWIST, TWIST_STAMPED, type_hash
from services.bridge_ros2.settings import BridgeRos2Settings

ROBOT = Node(Names(), "ab", "", "driver")


def token(kind, topic, message, number=1):
    return ROBOT.endpoint_token(kind, number, topic, message, Qos())


def why(*tokens):
    graph = Graph()
    for each in tokens:
        graph.change(each, there=True)
    return graph.why_silent("/scan", LASER_SCAN, "--scan-topic", nobody="NOBODY")


def test_nobody_another_topic_another_type_another_hash_or_just_silence():
    assert why() == "NOBODY"
    assert why(ROBOT.token()) == "NOBODY"
    text = why(token("MP", "/scan_raw", LASER_SCAN), token("MP", "/odom", ODOMETRY))
    assert "/scan_raw" in text
    assert "--scan-topic" in text
    assert "nor any other" in why(token("MP", "/odom", ODOMETRY))
    assert "of type nav_msgs/msg/Odometry" in why(token("MP", "/scan", ODOMETRY))
    foreign = token("MP", "/scan", LASER_SCAN).replace(type_hash(LASER_SCAN), "RIHS01_1234")
    text = why(foreign)
    assert "RIHS01_1234" in text
    assert type_hash(LASER_SCAN) in text
    assert "nothing arrives" in why(token("MP", "/scan", LASER_SCAN))
    assert "/driver" in why(token("MP", "/scan", LASER_SCAN))
    assert "nobody publishes it" in why(token("MS", "/scan", LASER_SCAN))


def test_whoever_goes_is_forgotten():
    graph = Graph()
    graph.change(token("MP", "/scan", LASER_SCAN), there=True)
    graph.change(token("MP", "/scan", LASER_SCAN), there=False)
    assert graph.endpoints() == []


def test_the_kind_of_command_that_the_robot_listens_for():
    graph = Graph()
    assert graph.twist_wanted("/cmd_vel") == ""
    graph.change(token("MS", "/cmd_vel", TWIST_STAMPED), there=True)
    assert graph.twist_wanted("/cmd_vel") == TWIST_STAMPED
    graph.change(token("MS", "/cmd_vel", TWIST, 2), there=True)
    assert graph.twist_wanted("/cmd_vel") == ""  # either will do


def test_a_complaint_names_the_option_that_mends_it():
    def said(graph, problem="", *, linked=True, quiet=0.0, heard=True, reckoned=True, **options):
        settings = BridgeRos2Settings(**options)
        return complaint(settings, graph, problem, linked=linked, quiet=quiet, heard=heard, reckoned=reckoned)

    graph = Graph()
    assert said(graph) == ""
    assert "it is gone" in said(graph, linked=False)
    assert said(graph, heard=False) == "no scan on /scan yet"
    assert "ROS domain 4" in said(graph, quiet=4.0, domain=4)
    assert "zenoh-bridge-ros2dds says of no topic" in said(graph, quiet=4.0, flavor="ros2dds")
    assert "on /r1/scan for 3 s" in said(graph, quiet=4.0, namespace="r1")
    assert said(graph, "too odd", quiet=4.0) == "scans on /scan cannot be used: too odd"
    assert "on /odom or in tf" in said(graph, reckoned=False)
    graph.change(token("MP", "/odom", ODOMETRY, 9), there=True)
    assert said(graph, odom_topic="odm") == "no odometry on /odm: nav_msgs/msg/Odometry is on /odom: --odom-topic"
    assert said(graph, odom_topic="odom") == ""
    graph.change(token("MP", "/odom", ODOMETRY, 9), there=False)
    assert said(graph, odom_topic="odm") == ""  # nothing to choose from: tf does
    assert said(graph, reckoned=False, tf="map-base") == ""
    graph.change(token("MS", "/cmd_vel", TWIST_STAMPED), there=True)
    assert said(graph) == "/cmd_vel: the robot listens for geometry_msgs/msg/TwistStamped: --stamped"
    assert said(graph, stamped=True) == said(graph, commands=False) == ""
