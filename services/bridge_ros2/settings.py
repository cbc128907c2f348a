"""Settings of the bridge."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.errors import UserError
from common.geometry.pose_text import POSE_PATTERN, parse_pose
from common.messages.ros_messages import Mount
from common.runtime.robot_settings import SelfFilterSettings
from services.bridge_ros2.keys import TOPIC_NAME, RosKeys, full_name

TOPIC = rf"^$|^{TOPIC_NAME}$"
ENDPOINT = r"[a-z]+/[^\s,]+:(6553[0-5]|655[0-2]\d|65[0-4]\d\d|6[0-4]\d{3}|[1-5]\d{4}|[1-9]\d{0,3})"
ENDPOINTS = rf"^{ENDPOINT}(,{ENDPOINT})*$"
FRAME = r"^[A-Za-z0-9_./-]{1,64}$"

# Names that rviz, nav2 and tf2 use; they are in the namespace like the others.
NODE = "presage"
MAP_FRAME = "map"
TF_TOPIC = "tf"  # fixed transforms are on tf_static
POSE_TOPIC = "amcl_pose"
HYPOTHESES_TOPIC = "pose_hypotheses"
INITIAL_POSE_TOPIC = "initialpose"
GOAL_TOPIC = "goal_pose"
MAP_TOPIC = "map"
TRANSFORM_TOLERANCE_S = 1.0  # by which the transform is stamped ahead, as in AMCL


class BridgeRos2Settings(SelfFilterSettings):
    """Bridge to ROS 2: a robot, or Gazebo, replaces the simulator, and presage replaces AMCL. ROS is not needed here.

    On the robot: RMW_IMPLEMENTATION=rmw_zenoh_cpp and `ros2 run rmw_zenoh_cpp rmw_zenohd`, or zenoh-bridge-ros2dds.

    Examples:
      python -m services.bridge_ros2 --ros-connect tcp/ROBOT:7447         localise and drive the robot
      python -m services.bridge_ros2 --ros-connect tcp/ROBOT:7447 --no-commands      only localise; nav2 drives
      python -m services.bridge_ros2 --ros-connect tcp/ROBOT:7447 --flavor ros2dds   with zenoh-bridge-ros2dds
      python -m services.bridge_ros2 --distro humble --cmd-topic cmd_vel --drive differential
      python -m services.bridge_ros2 --namespace robot1 --scan-topic scan --stamped
      python -m services.bridge_ros2 --publish-map --world my.yaml        rviz and nav2 without a map_server
      python -m services.bridge_ros2 --mount 0.1,0,180 --upside-down      if tf does not contain the laser's mount

    For TurtleBot, TIAGo, rviz and nav2, see docs/ros2.md.

    """

    service: ClassVar[str] = "bridge_ros2"
    private: ClassVar[frozenset[str]] = frozenset(
        {
            "namespace",
            "domain",
            "distro",
            "flavor",
            "mount",
            "upside_down",
            "stamped",
            "commands",
            "tf",
        }
    )

    ros_connect: Annotated[
        str,
        Field(pattern=ENDPOINTS, description="tcp/HOST:PORT of the robot's zenoh router, or of zenoh-bridge-ros2dds"),
    ] = "tcp/127.0.0.1:7447"
    ros_config: Annotated[
        Path | None,
        Field(
            description="JSON5 file with a zenoh configuration for that session, e.g. for TLS; replaces --ros-connect"
        ),
    ] = None
    flavor: Annotated[
        Literal["rmw_zenoh", "ros2dds"],
        Field(description="what connects the robot's nodes to zenoh: rmw_zenoh, or ros2dds for zenoh-bridge-ros2dds"),
    ] = "rmw_zenoh"
    distro: Annotated[
        Literal["humble", "jazzy"],
        Field(
            description="ROS distribution: humble (types without hashes), or jazzy (also for Iron, Kilted and later); "
            "only matters for rmw_zenoh"
        ),
    ] = "jazzy"
    domain: Annotated[int, Field(ge=0, le=232, description="ROS_DOMAIN_ID")] = 0
    namespace: Annotated[
        str, Field(pattern=rf"^$|^{TOPIC_NAME}/?$", description="namespace of relative topic names, such as robot1")
    ] = ""

    scan_topic: Annotated[
        str, Field(pattern=rf"^{TOPIC_NAME}$", description="topic with scans (sensor_msgs/LaserScan)")
    ] = "scan"
    odom_topic: Annotated[
        str,
        Field(pattern=TOPIC, description="topic with odometry (nav_msgs/Odometry); empty to use odometry from tf"),
    ] = "odom"
    cmd_topic: Annotated[str, Field(pattern=rf"^{TOPIC_NAME}$", description="topic for velocity commands")] = "cmd_vel"
    stamped: Annotated[bool, Field(description="send commands as TwistStamped instead of Twist")] = False
    commands: Annotated[
        bool,
        Field(description="pass velocity commands and goals on; use --no-commands if nav2 or another program drives"),
    ] = True

    publish_map: Annotated[
        bool, Field(description="publish the world as OccupancyGrid; only if no map_server is running")
    ] = False
    world: Annotated[
        str,
        Field(
            description="world to publish with --publish-map: a shipped world, a world file or a ROS map.yaml; "
            "the same as the estimator's"
        ),
    ] = "corridor"

    odom_frame: Annotated[str, Field(pattern=FRAME, description="frame of the odometry")] = "odom"
    base_frame: Annotated[str, Field(pattern=FRAME, description="frame of the robot's centre")] = "base_link"
    tf: Annotated[
        Literal["map-odom", "map-base", "none"],
        Field(
            description="transform to publish: map-odom, as AMCL; map-base for a robot without odometry; "
            "none if another node publishes it"
        ),
    ] = "map-odom"
    mount: Annotated[
        str,
        Field(
            pattern=POSE_PATTERN,
            description="x,y[,yaw_deg] (m, m, degrees): pose of the laser in the base frame; defaults to the one in tf",
        ),
    ] = ""
    upside_down: Annotated[bool, Field(description="with --mount: the laser's z axis points down")] = False

    obstacle_stop: Annotated[bool, Field(description="slow down and stop before obstacles in the scan")] = True

    def ros_keys(self) -> RosKeys:
        """Zenoh keys of the configured flavour and domain."""
        return RosKeys(self.flavor, self.domain, hashes=self.distro != "humble")

    @property
    def ros_endpoint(self) -> str:
        """Where the robot's router is, as the user gave it: the endpoint, or the file that states it."""
        return str(self.ros_config or self.ros_connect)

    def check(self) -> None:
        """Raises UserError if settings contradict each other, or if a file is missing."""
        frames = {"the map": MAP_FRAME, "--odom-frame": self.odom_frame, "--base-frame": self.base_frame}
        if len(set(frames.values())) < len(frames):
            options = ", ".join(f"{option} {name}" for option, name in frames.items())
            raise UserError(f"{options}: these are three frames, each needs a name of its own")
        if self.ros_config is not None and not self.ros_config.is_file():
            raise UserError(f"--ros-config {self.ros_config}: there is no such file")
        if self.scan_topic == self.odom_topic:
            raise UserError(f"--scan-topic and --odom-topic are both {self.scan_topic!r}: a topic has one type")

    def topic(self, name: str) -> str:
        """A topic's absolute name."""
        return full_name(name, self.namespace)

    def build_mount(self) -> Mount | None:
        """The configured mount of the laser. Returns None if tf should be used."""
        if not self.mount:
            if self.upside_down:
                raise UserError("--upside-down needs --mount x,y[,yaw_deg]: without it the mount is taken from tf")
            return None
        x, y, yaw = map(float, parse_pose(self.mount, "--mount"))
        return Mount((x, y, yaw), self.upside_down)
