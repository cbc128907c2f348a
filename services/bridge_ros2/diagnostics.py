"""Explains why no scan arrives, and other problems on the ROS side, for the health note."""

from __future__ import annotations

from typing import TYPE_CHECKING

from services.bridge_ros2.graph import join_names
from services.bridge_ros2.ros_types import LASER_SCAN, ODOMETRY, TWIST_STAMPED
from services.bridge_ros2.settings import MAP_TOPIC

if TYPE_CHECKING:
    from services.bridge_ros2.graph import RosGraph
    from services.bridge_ros2.settings import BridgeRos2Settings

SCAN_TIMEOUT_S = 3.0  # after this time without a scan, the health note explains why


def diagnose(
    options: BridgeRos2Settings,
    graph: RosGraph,
    problem: str,
    *,
    linked: bool,
    scan_age: float,
    received: bool,
    with_odometry: bool,
) -> str:
    """Explains what is wrong, and which option corrects it. Returns an empty string if nothing is wrong.

    ``problem``: why the last scan could not be used. ``scan_age``: seconds since the last usable scan, or since the
    start. ``received``: whether there was a usable scan. ``with_odometry``: whether the last scan had odometry for its
    stamp.
    """
    topic = options.topic(options.scan_topic)
    if not linked:
        return f"waiting for the zenoh router at {options.ros_endpoint}: the connection is lost"
    if mismatch := graph.distro_mismatch(topic):
        return mismatch
    if scan_age > SCAN_TIMEOUT_S:
        if problem:
            return f"scans on {topic} cannot be used: {problem}"
        reason = graph.explain_silence(
            topic, LASER_SCAN, "--scan-topic", no_endpoints=_explain_missing_endpoints(options, graph)
        )
        return f"no scan on {topic} for {SCAN_TIMEOUT_S:g} s: {reason}"
    return _diagnose_other(options, graph, with_odometry=with_odometry) if received else f"no scan on {topic} yet"


def _diagnose_other(options: BridgeRos2Settings, graph: RosGraph, *, with_odometry: bool) -> str:
    """Explains what else is wrong while scans arrive, or returns an empty string."""
    if problem := _wrong_odometry_topic(options, graph):
        return problem
    if options.tf == "map-odom" and not with_odometry:
        where = f"on {options.topic(options.odom_topic)} or in tf" if options.odom_topic else "in tf"
        return (
            f"no odometry for the times of the scans {where}, so the transform from map to odom is not published; "
            "set --odom-topic, or --tf map-base for a robot without odometry"
        )
    map_topic = options.topic(MAP_TOPIC)
    if options.publish_map and (other := graph.publishers(map_topic)):
        return f"{other} also publishes a map on {map_topic}; leave out --publish-map"
    command = options.topic(options.cmd_topic)
    expected = graph.expected_twist_type(command) if options.commands else ""
    if expected and (expected == TWIST_STAMPED) != options.stamped:
        return f"the robot expects {expected} on {command}; set --{'' if expected == TWIST_STAMPED else 'no-'}stamped"
    return ""


def _wrong_odometry_topic(options: BridgeRos2Settings, graph: RosGraph) -> str:
    """Explains that the odometry topic set by the user does not exist while others of its type do.

    Returns an empty string if the topic was not set explicitly, because then odometry from tf is fine.
    """
    if "odom_topic" not in options.model_fields_set or not options.odom_topic:
        return ""
    topic = options.topic(options.odom_topic)
    existing = graph.topics_of(ODOMETRY)
    if not existing or topic in existing:
        return ""
    return f"no odometry on {topic}; set --odom-topic: {ODOMETRY} is published on {join_names(existing)}"


def _explain_missing_endpoints(options: BridgeRos2Settings, graph: RosGraph) -> str:
    """Explains why there are no endpoints of the configured flavour and domain."""
    other_endpoints = graph.other_endpoints()
    domains = sorted(
        {each.domain for each in other_endpoints if each.flavor == "rmw_zenoh" and each.domain is not None}
    )
    if options.flavor == "rmw_zenoh":
        if any(each.flavor == "ros2dds" for each in other_endpoints):
            return "the robot uses zenoh-bridge-ros2dds, not rmw_zenoh; set --flavor ros2dds"
        if domains:
            others = join_names([str(domain) for domain in domains])
            return f"there are no nodes in ROS domain {options.domain}, but in {others}; set --domain {domains[0]}"
    elif domains:
        domain = "" if options.domain in domains else f" --domain {domains[0]}"
        return f"the robot uses rmw_zenoh, not zenoh-bridge-ros2dds; set --flavor rmw_zenoh{domain}"
    where = (
        f"there are no ROS nodes at {options.ros_endpoint}. Check that this is the robot's router, not presage's, and"
    )
    if options.flavor == "ros2dds":
        return f"{where} that zenoh-bridge-ros2dds runs there with the ROS_DOMAIN_ID of the robot's nodes"
    return f"{where} that the nodes run with RMW_IMPLEMENTATION=rmw_zenoh_cpp and `ros2 topic list` shows them"
