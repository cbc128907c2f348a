"""Explanations why messages do not arrive."""

from __future__ import annotations

from services.bridge_ros2.diagnostics import diagnose
from services.bridge_ros2.graph import Graph
from services.bridge_ros2.keys import Names, Node, Qos
from services.bridge_ros2.ros_types import LASER_SCAN, OCCUPANCY_GRID, ODOMETRY, TWIST, TWIST_STAMPED, type_hash
from services.bridge_ros2.settings import BridgeRos2Settings

ROBOT = Node(Names(), "ab", "", "driver")


def token(kind, topic, message, number=1):
    return ROBOT.endpoint_token(kind, number, topic, message, Qos())


def why(*tokens):
    graph = Graph()
    for each in tokens:
        graph.change(each, alive=True)
    return graph.explain_silence("/scan", LASER_SCAN, "--scan-topic", no_endpoints="NOBODY")


def test_nobody_another_topic_another_type_another_hash_or_just_silence():
    assert why() == "NOBODY"
    assert why(ROBOT.token()) == "NOBODY"
    text = why(token("MP", "/scan_raw", LASER_SCAN), token("MP", "/odom", ODOMETRY))
    assert "/scan_raw" in text
    assert "--scan-topic" in text
    assert "no node publishes sensor_msgs/msg/LaserScan" in why(token("MP", "/odom", ODOMETRY))
    assert "its type is nav_msgs/msg/Odometry" in why(token("MP", "/scan", ODOMETRY))
    foreign = token("MP", "/scan", LASER_SCAN).replace(type_hash(LASER_SCAN), "RIHS01_1234")
    text = why(foreign)
    assert "RIHS01_1234" in text
    assert type_hash(LASER_SCAN) in text
    assert "nothing arrives" in why(token("MP", "/scan", LASER_SCAN))
    assert "/driver" in why(token("MP", "/scan", LASER_SCAN))
    assert "no node publishes" in why(token("MS", "/scan", LASER_SCAN))


def test_whoever_goes_is_forgotten():
    graph = Graph()
    graph.change(token("MP", "/scan", LASER_SCAN), alive=True)
    graph.change(token("MP", "/scan", LASER_SCAN), alive=False)
    assert graph.endpoints() == []


def test_the_kind_of_command_that_the_robot_listens_for():
    graph = Graph()
    assert graph.expected_twist_type("/cmd_vel") == ""
    graph.change(token("MS", "/cmd_vel", TWIST_STAMPED), alive=True)
    assert graph.expected_twist_type("/cmd_vel") == TWIST_STAMPED
    graph.change(token("MS", "/cmd_vel", TWIST, 2), alive=True)
    assert graph.expected_twist_type("/cmd_vel") == ""  # both types have a subscriber


def test_a_complaint_names_the_option_that_mends_it():
    def said(graph, problem="", *, linked=True, scan_age=0.0, received=True, with_odometry=True, **options):
        settings = BridgeRos2Settings(**options)
        return diagnose(
            settings, graph, problem, linked=linked, scan_age=scan_age, received=received, with_odometry=with_odometry
        )

    graph = Graph()
    assert said(graph) == ""
    assert "the connection is lost" in said(graph, linked=False)
    assert said(graph, received=False) == "no scan on /scan yet"
    nothing = said(graph, scan_age=4.0, ros_connect="tcp/rover:7447")
    assert "there are no ROS nodes at tcp/rover:7447" in nothing
    assert "RMW_IMPLEMENTATION=rmw_zenoh_cpp" in nothing
    assert "that zenoh-bridge-ros2dds runs there" in said(graph, scan_age=4.0, flavor="ros2dds")
    assert said(graph, scan_age=1.0, received=False) == "no scan on /scan yet"  # only after the timeout
    assert "on /r1/scan for 3 s" in said(graph, scan_age=4.0, namespace="r1")
    assert said(graph, "too odd", scan_age=4.0) == "scans on /scan cannot be used: too odd"
    assert "on /odom or in tf" in said(graph, with_odometry=False)
    graph.change(token("MP", "/odom", ODOMETRY, 9), alive=True)
    assert (
        said(graph, odom_topic="odm")
        == "no odometry on /odm; set --odom-topic: nav_msgs/msg/Odometry is published on /odom"
    )
    assert said(graph, odom_topic="odom") == ""
    graph.change(token("MP", "/odom", ODOMETRY, 9), alive=False)
    assert said(graph, odom_topic="odm") == ""  # no other odometry topic exists, so tf is used
    assert said(graph, with_odometry=False, tf="map-base") == ""
    graph.change(token("MS", "/cmd_vel", TWIST_STAMPED), alive=True)
    assert said(graph) == "the robot expects geometry_msgs/msg/TwistStamped on /cmd_vel; set --stamped"
    assert said(graph, stamped=True) == said(graph, commands=False) == ""


DDS_SCAN = "@/a1/@ros2_lv/MP/scan/sensor_msgs§msg§LaserScan/:::"


def silent(*tokens, **options):
    """The explanation for a scan that has not arrived for 4 s."""
    settings = BridgeRos2Settings(**options)
    graph = Graph(settings.names())
    for each in tokens:
        graph.change(each, alive=True)
    return diagnose(settings, graph, "", linked=True, scan_age=4.0, received=False, with_odometry=False)


def test_the_other_flavor_and_another_domain_are_named():
    far = Node(Names(domain=5), "ab", "", "driver").endpoint_token("MP", 1, "/scan", LASER_SCAN, Qos())
    assert silent(DDS_SCAN).endswith("uses zenoh-bridge-ros2dds, not rmw_zenoh; set --flavor ros2dds")
    assert "in ROS domain 0, but in 5; set --domain 5" in silent(far)
    assert silent(far, flavor="ros2dds").endswith("--flavor rmw_zenoh --domain 5")
    assert silent(token("MP", "/scan", LASER_SCAN), flavor="ros2dds").endswith("--flavor rmw_zenoh")
    # rviz is there, but the scanner is not.
    assert "--flavor ros2dds" in silent(DDS_SCAN, token("MS", "/scan", LASER_SCAN))
    assert "--domain 5" in silent(far, token("MP", "/odom", ODOMETRY))
    assert "nothing arrives" in silent(far, token("MP", "/scan", LASER_SCAN))
    assert "nothing arrives" in silent(DDS_SCAN, flavor="ros2dds", domain=3)  # its tokens do not contain the domain


def test_a_distro_that_does_not_fit_is_named_though_scans_come():
    """Scans of a Humble robot arrive with any hash, but the robot silently drops messages that have one."""
    humble = Node(Names(hashes=False), "ab", "", "driver")
    jazzy = token("MP", "/scan", LASER_SCAN)

    def said(*tokens, distro):
        settings = BridgeRos2Settings(distro=distro)
        graph = Graph(settings.names())
        for each in tokens:
            graph.change(each, alive=True)
        return diagnose(settings, graph, "", linked=True, scan_age=0.0, received=True, with_odometry=True)

    scans, listens = (humble.endpoint_token(*each, Qos()) for each in (
        ("MP", 1, "/scan", LASER_SCAN), ("MS", 2, "/cmd_vel", TWIST),
    ))  # fmt: skip
    assert "types of /driver have no hashes, as in Humble; set --distro humble" in said(scans, distro="jazzy")
    assert "--distro humble" in said(listens, distro="jazzy")
    assert "--distro jazzy" in said(jazzy, distro="humble")
    assert said(scans, distro="humble") == said(jazzy, distro="jazzy") == ""
    # With several nodes, the one that publishes scans decides.
    rviz = token("MS", "/amcl_pose", ODOMETRY, 3)
    assert said(scans, rviz, distro="humble") == ""
    assert "--distro humble" in said(scans, rviz, distro="jazzy")
    assert said(listens, rviz, distro="jazzy") == said(listens, rviz, distro="humble") == ""


def test_a_second_map_is_named():
    graph = Graph()
    graph.change(token("MP", "/map", OCCUPANCY_GRID), alive=True)
    for publish, says in ((True, "/driver also publishes a map on /map; leave out --publish-map"), (False, "")):
        settings = BridgeRos2Settings(publish_map=publish)
        said = diagnose(settings, graph, "", linked=True, scan_age=0.0, received=True, with_odometry=True)
        assert said.startswith(says)
        assert bool(said) is publish


def test_a_token_of_a_domain_that_is_no_number_is_nobodys():
    graph = Graph()
    graph.change(token("MP", "/scan", LASER_SCAN).replace("@ros2_lv/0/", "@ros2_lv/x/"), alive=True)
    assert len(graph.other_endpoints()) + len(graph.endpoints()) == 1
