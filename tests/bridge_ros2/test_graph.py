"""Explanations why messages do not arrive."""

from __future__ import annotations

import pytest

from services.bridge_ros2.diagnostics import diagnose
from services.bridge_ros2.graph import RosGraph
from services.bridge_ros2.keys import BridgeNode, Qos, RosKeys
from services.bridge_ros2.ros_types import LASER_SCAN, OCCUPANCY_GRID, ODOMETRY, TWIST, TWIST_STAMPED, type_hash
from services.bridge_ros2.settings import BridgeRos2Settings


def token(kind, topic, message, number=1, **keys):
    return BridgeNode(RosKeys(**keys), "ab", "", "driver").endpoint_token(kind, number, topic, message, Qos())


NODE = BridgeNode(RosKeys(), "ab", "", "driver").token()
SCANS, ODOM = token("MP", "/scan", LASER_SCAN), token("MP", "/odom", ODOMETRY, 9)
LISTENS_STAMPED, LISTENS = token("MS", "/cmd_vel", TWIST_STAMPED), token("MS", "/cmd_vel", TWIST, 2)
FAR = token("MP", "/scan", LASER_SCAN, domain=5)
HUMBLE_SCANS, HUMBLE_LISTENS = (
    token("MP", "/scan", LASER_SCAN, hashes=False),
    token("MS", "/cmd_vel", TWIST, 2, hashes=False),
)
RVIZ = token("MS", "/amcl_pose", ODOMETRY, 3)
DDS_SCAN = "@/a1/@ros2_lv/MP/scan/sensor_msgs§msg§LaserScan/:::"


def graph_of(tokens, **keys):
    graph = RosGraph(**keys)
    for each in tokens:
        graph.change(each, alive=True)
    return graph


@pytest.mark.parametrize(
    ("tokens", "says"),
    [
        ((), ["NO NODES"]),
        ((NODE,), ["NO NODES"]),
        ((token("MP", "/scan_raw", LASER_SCAN), ODOM), ["/scan_raw", "--scan-topic"]),
        ((ODOM,), ["no node publishes sensor_msgs/msg/LaserScan"]),
        ((token("MP", "/scan", ODOMETRY),), ["its type is nav_msgs/msg/Odometry"]),
        ((SCANS.replace(type_hash(LASER_SCAN), "RIHS01_1234"),), ["RIHS01_1234", type_hash(LASER_SCAN)]),
        ((SCANS,), ["nothing arrives", "/driver"]),
        ((token("MS", "/scan", LASER_SCAN),), ["no node publishes"]),
    ],
)
def test_reasons_for_silence(tokens, says):
    text = graph_of(tokens).explain_silence("/scan", LASER_SCAN, "--scan-topic", no_endpoints="NO NODES")
    assert all(part in text for part in says), text


def test_vanished_endpoint():
    graph = graph_of([SCANS])
    graph.change(SCANS, alive=False)
    assert graph.endpoints() == []


@pytest.mark.parametrize(
    ("tokens", "kind"), [((), ""), ((LISTENS_STAMPED,), TWIST_STAMPED), ((LISTENS_STAMPED, LISTENS), "")]
)
def test_expected_twist_type(tokens, kind):
    assert graph_of(tokens).expected_twist_type("/cmd_vel") == kind


def diagnosis(*tokens, problem="", linked=True, scan_age=0.0, received=True, with_odometry=True, **options):
    settings = BridgeRos2Settings(**options)
    graph = graph_of(tokens, keys=settings.ros_keys())
    return diagnose(
        settings, graph, problem, linked=linked, scan_age=scan_age, received=received, with_odometry=with_odometry
    )


@pytest.mark.parametrize(
    ("tokens", "given", "says"),
    [
        ((), {"linked": False}, "the connection is lost"),
        ((), {"received": False}, "no scan on /scan yet"),
        ((), {"scan_age": 1.0, "received": False}, "no scan on /scan yet"),  # only after the timeout
        ((), {"scan_age": 4.0, "ros_connect": "tcp/rover:7447"}, "there are no ROS nodes at tcp/rover:7447"),
        ((), {"scan_age": 4.0}, "RMW_IMPLEMENTATION=rmw_zenoh_cpp"),
        ((), {"scan_age": 4.0, "flavor": "ros2dds"}, "that zenoh-bridge-ros2dds runs there"),
        ((), {"scan_age": 4.0, "namespace": "r1"}, "on /r1/scan for 3 s"),
        ((), {"scan_age": 4.0, "problem": "too odd"}, "scans on /scan cannot be used: too odd"),
        ((), {"with_odometry": False}, "on /odom or in tf"),
        (
            (ODOM,),
            {"odom_topic": "odm"},
            "no odometry on /odm; set --odom-topic: nav_msgs/msg/Odometry is published on /odom",
        ),
        ((LISTENS_STAMPED,), {}, "the robot expects geometry_msgs/msg/TwistStamped on /cmd_vel; set --stamped"),
        # The other flavor, or another domain.
        ((DDS_SCAN,), {"scan_age": 4.0}, "uses zenoh-bridge-ros2dds, not rmw_zenoh; set --flavor ros2dds"),
        ((FAR,), {"scan_age": 4.0}, "in ROS domain 0, but in 5; set --domain 5"),
        ((FAR,), {"scan_age": 4.0, "flavor": "ros2dds"}, "--flavor rmw_zenoh --domain 5"),
        ((SCANS,), {"scan_age": 4.0, "flavor": "ros2dds"}, "--flavor rmw_zenoh"),
        ((DDS_SCAN, token("MS", "/scan", LASER_SCAN)), {"scan_age": 4.0}, "--flavor ros2dds"),  # rviz is there
        ((FAR, ODOM), {"scan_age": 4.0}, "--domain 5"),
        ((FAR, SCANS), {"scan_age": 4.0}, "nothing arrives"),
        (
            (DDS_SCAN,),
            {"scan_age": 4.0, "flavor": "ros2dds", "domain": 3},
            "nothing arrives",
        ),  # no domain in its tokens
        # Another distro: scans arrive with any hash, but the robot silently drops messages that have one.
        ((HUMBLE_SCANS,), {}, "types of /driver have no hashes, as in Humble; set --distro humble"),
        ((HUMBLE_LISTENS,), {}, "--distro humble"),
        ((HUMBLE_SCANS, RVIZ), {}, "--distro humble"),  # the node that publishes scans decides
        ((SCANS,), {"distro": "humble"}, "--distro jazzy"),
        (
            (token("MP", "/map", OCCUPANCY_GRID),),
            {"publish_map": True},
            "/driver also publishes a map on /map; leave out --publish-map",
        ),
    ],
)
def test_diagnoses_and_options(tokens, given, says):
    assert says in diagnosis(*tokens, **given)


@pytest.mark.parametrize(
    ("tokens", "given"),
    [
        ((), {}),
        ((), {"odom_topic": "odm"}),  # no other odometry topic exists, so tf is used
        ((ODOM,), {"odom_topic": "odom"}),
        ((), {"with_odometry": False, "tf": "map-base"}),
        ((LISTENS_STAMPED,), {"stamped": True}),
        ((LISTENS_STAMPED,), {"commands": False}),
        ((HUMBLE_SCANS,), {"distro": "humble"}),
        ((HUMBLE_SCANS, RVIZ), {"distro": "humble"}),
        ((SCANS,), {}),
        ((HUMBLE_LISTENS, RVIZ), {}),
        ((HUMBLE_LISTENS, RVIZ), {"distro": "humble"}),
        ((token("MP", "/map", OCCUPANCY_GRID),), {}),
    ],
)
def test_nothing_wrong(tokens, given):
    assert diagnosis(*tokens, **given) == ""


def test_token_without_a_domain_number():
    graph = graph_of([SCANS.replace("@ros2_lv/0/", "@ros2_lv/x/")])
    assert len(graph.other_endpoints()) + len(graph.endpoints()) == 1
