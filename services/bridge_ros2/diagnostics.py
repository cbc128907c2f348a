"""Explains in one line why no scan arrives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from services.bridge_ros2.graph import join_names
from services.bridge_ros2.ros_types import LASER_SCAN, ODOMETRY, TWIST_STAMPED
from services.bridge_ros2.settings import MAP_TOPIC

if TYPE_CHECKING:
    from services.bridge_ros2.graph import Graph
    from services.bridge_ros2.settings import BridgeRos2Settings

SCAN_TIMEOUT_S = 3.0  # after this time without a scan, the health note explains why


def diagnose(
    options: BridgeRos2Settings, graph: Graph, problem: str, *, linked: bool, quiet: float, heard: bool, reckoned: bool
) -> str:
    """Explains what is wrong in one line. Returns an empty string if nothing is.

    ``problem``: why the last scan could not be used. ``quiet``: seconds since the last usable scan, or since the start.
    ``heard``: whether there was a usable scan. ``reckoned``: whether the last scan had odometry for its stamp.
    """
    topic = options.topic(options.scan_topic)
    if not linked:
        return f"waits for the zenoh router at {options.ros_connect}: it is gone"
    if wrong := graph.distro_mismatch(topic):
        return wrong
    if quiet > SCAN_TIMEOUT_S:
        if problem:
            return f"scans on {topic} cannot be used: {problem}"
        why = graph.why_silent(topic, LASER_SCAN, "--scan-topic", no_endpoints=_no_endpoint_reason(options, graph))
        return f"no scan on {topic} for {SCAN_TIMEOUT_S:g} s: {why}"
    return _with_scans(options, graph, reckoned=reckoned) if heard else f"no scan on {topic} yet"


def _with_scans(options: BridgeRos2Settings, graph: Graph, *, reckoned: bool) -> str:
    """Explains what else is wrong while scans arrive, or returns an empty string."""
    if wrong := _no_odometry(options, graph):
        return wrong
    if options.tf == "map-odom" and not reckoned:
        where = f"on {options.topic(options.odom_topic)} or in tf" if options.odom_topic else "in tf"
        return (
            f"no odometry of the scans' moments {where}, so no transform from map to odom: --odom-topic, --tf map-base"
        )
    map_topic = options.topic(MAP_TOPIC)
    if options.publish_map and (other := graph.publishers(map_topic)):
        return f"{map_topic}: {other} publishes a map there as well: leave out --publish-map"
    command = options.topic(options.cmd_topic)
    wanted = graph.expected_twist_type(command) if options.commands else ""
    if wanted and (wanted == TWIST_STAMPED) != options.stamped:
        return f"{command}: the robot listens for {wanted}: --{'' if wanted == TWIST_STAMPED else 'no-'}stamped"
    return ""


def _no_odometry(options: BridgeRos2Settings, graph: Graph) -> str:
    """Explains that the odometry topic set by the user does not exist while others of its type do.

    Returns an empty string if the topic was not set explicitly, because then odometry from tf is fine.
    """
    if "odom_topic" not in options.model_fields_set or not options.odom_topic:
        return ""
    topic = options.topic(options.odom_topic)
    there = graph.topics_of(ODOMETRY)
    if not there or topic in there:
        return ""
    return f"no odometry on {topic}: {ODOMETRY} is on {join_names(there)}: --odom-topic"


def _no_endpoint_reason(options: BridgeRos2Settings, graph: Graph) -> str:
    """Explains why no endpoints of the configured flavour and domain exist: others do, or what to check."""
    other_endpoints = graph.other_endpoints()
    domains = sorted(
        {each.domain for each in other_endpoints if each.flavor == "rmw_zenoh" and each.domain is not None}
    )
    if options.flavor == "rmw_zenoh":
        if any(each.flavor == "ros2dds" for each in other_endpoints):
            return "there it is zenoh-bridge-ros2dds that speaks, not rmw_zenoh: --flavor ros2dds"
        if domains:
            others = join_names([str(domain) for domain in domains])
            return f"nobody is seen in ROS domain {options.domain}, but in {others}: --domain {domains[0]}"
    elif domains:
        domain = "" if options.domain in domains else f" --domain {domains[0]}"
        return f"there it is rmw_zenoh that speaks, not zenoh-bridge-ros2dds: --flavor rmw_zenoh{domain}"
    where = f"nothing of ROS is heard at {options.ros_connect}: is that the robot's, and not presage's own router?"
    if options.flavor == "ros2dds":
        return f"{where} does zenoh-bridge-ros2dds run there, in the ROS_DOMAIN_ID of the robot's nodes?"
    return f"{where} do its nodes run with RMW_IMPLEMENTATION=rmw_zenoh_cpp, and does ros2 topic list show them there?"
