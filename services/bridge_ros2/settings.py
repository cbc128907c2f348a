"""Settings of the bridge."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.errors import UserError
from common.geometry.pose_text import POSE_TEXT, pose_of_text
from common.messages.ros_messages import Mount
from common.runtime.robot_settings import SeenRobotSettings
from services.bridge_ros2.keys import NAME, Names, full_name

TOPIC = rf"^$|^{NAME}$"
ENDPOINT = r"[a-z]+/[^\s,]+:(6553[0-5]|655[0-2]\d|65[0-4]\d\d|6[0-4]\d{3}|[1-5]\d{4}|[1-9]\d{0,3})"
ENDPOINTS = rf"^{ENDPOINT}(,{ENDPOINT})*$"
FRAME = r"^[A-Za-z0-9_./-]{1,64}$"


class BridgeRos2Settings(SeenRobotSettings):
    """Bridge to ROS 2: a robot, or Gazebo, in the simulator's place; presage in AMCL's. Needs no ROS here.

    On the robot: RMW_IMPLEMENTATION=rmw_zenoh_cpp and `ros2 run rmw_zenoh_cpp rmw_zenohd`, or zenoh-bridge-ros2dds.

    Examples:
      python -m services.bridge_ros2 --ros-connect tcp/ROBOT:7447         its scans, odometry and tf, and it drives
      python -m services.bridge_ros2 --ros-connect tcp/ROBOT:7447 --no-commands      nav2 drives: localise it, no more
      python -m services.bridge_ros2 --ros-connect tcp/ROBOT:7447 --flavor ros2dds   through zenoh-bridge-ros2dds
      python -m services.bridge_ros2 --distro humble --cmd-topic cmd_vel --drive differential
      python -m services.bridge_ros2 --namespace robot1 --scan-topic scan --stamped
      python -m services.bridge_ros2 --publish-map --world my.yaml        rviz and nav2 without a map_server
      python -m services.bridge_ros2 --mount 0.1,0,180 --upside-down      where tf does not say how the laser sits

    More, with TurtleBot, TIAGo, rviz and nav2: docs/ros2.md.

    """

    service: ClassVar[str] = "bridge_ros2"
    private: ClassVar[frozenset[str]] = frozenset(
        {
            "namespace",
            "domain",
            "distro",
            "flavor",
            "node",
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
        Path | None, Field(description="zenoh configuration of that session (TLS, say), a JSON5 file; none: our own")
    ] = None
    flavor: Annotated[
        Literal["rmw_zenoh", "ros2dds"], Field(description="rmw_zenoh; ros2dds: zenoh-bridge-ros2dds")
    ] = "rmw_zenoh"
    distro: Annotated[
        Literal["humble", "jazzy"],
        Field(description="humble: types have no hashes; jazzy: as Iron, Kilted and later (rmw_zenoh alone minds)"),
    ] = "jazzy"
    domain: Annotated[int, Field(ge=0, le=232, description="ROS_DOMAIN_ID")] = 0
    namespace: Annotated[
        str, Field(pattern=rf"^$|^{NAME}/?$", description="before relative topic names, such as robot1")
    ] = ""
    node: Annotated[
        str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", description="our name in the ROS graph; letters, digits, _")
    ] = "presage"

    scan_topic: Annotated[
        str, Field(pattern=rf"^{NAME}$", description="name of the topic with sensor_msgs/LaserScan")
    ] = "scan"
    odom_topic: Annotated[
        str, Field(pattern=TOPIC, description="name of that with nav_msgs/Odometry; empty: odometry from tf")
    ] = "odom"
    tf_topic: Annotated[
        str, Field(pattern=rf"^{NAME}$", description="name of that with tf2_msgs/TFMessage, and of it with _static")
    ] = "tf"
    cmd_topic: Annotated[str, Field(pattern=rf"^{NAME}$", description="name of the topic for velocity commands")] = (
        "cmd_vel"
    )
    stamped: Annotated[bool, Field(description="commands as TwistStamped, else Twist")] = False
    pose_topic: Annotated[
        str, Field(pattern=TOPIC, description="PoseWithCovarianceStamped of the belief; empty: none")
    ] = "amcl_pose"
    hypotheses_topic: Annotated[str, Field(pattern=TOPIC, description="PoseArray of all possible places")] = (
        "pose_hypotheses"
    )
    initial_pose_topic: Annotated[str, Field(pattern=TOPIC, description="rviz's 2D Pose Estimate")] = "initialpose"
    goal_topic: Annotated[str, Field(pattern=TOPIC, description="rviz's 2D Goal Pose")] = "goal_pose"
    commands: Annotated[
        bool, Field(description="pass velocity commands and goals on; --no-commands: others drive, such as nav2")
    ] = True

    publish_map: Annotated[
        bool, Field(description="publish the world as OccupancyGrid, in map_server's place; not where one runs")
    ] = False
    map_topic: Annotated[str, Field(pattern=rf"^{NAME}$", description="of --publish-map")] = "map"
    world: Annotated[
        str, Field(description="of --publish-map: shipped world, world file or ROS map.yaml, that of the estimator")
    ] = "corridor"

    map_frame: Annotated[str, Field(pattern=FRAME, description="the world")] = "map"
    odom_frame: Annotated[str, Field(pattern=FRAME, description="of dead reckoning")] = "odom"
    base_frame: Annotated[str, Field(pattern=FRAME, description="of the robot's centre")] = "base_link"
    tf: Annotated[
        Literal["map-odom", "map-base", "none"],
        Field(description="map-odom: as AMCL; map-base: of a robot without odometry; none: somebody else says it"),
    ] = "map-odom"
    transform_tolerance: Annotated[
        float, Field(ge=0, le=60, description="s by which that transform is dated ahead, as AMCL's")
    ] = 1.0
    mount: Annotated[
        str,
        Field(
            pattern=POSE_TEXT,
            description="x,y[,yaw_deg] (m, m, degrees) of the laser in the base frame; none: tf says",
        ),
    ] = ""
    upside_down: Annotated[bool, Field(description="with --mount: its z axis points down")] = False

    obstacle_stop: Annotated[bool, Field(description="slow commands down before what the scan shows")] = True

    def names(self) -> Names:
        """How topics are called on zenoh."""
        return Names(self.flavor, self.domain, hashes=self.distro != "humble")

    def check(self) -> None:
        """Raises UserError where two of these settings do not go together."""
        frames = {"--map-frame": self.map_frame, "--odom-frame": self.odom_frame, "--base-frame": self.base_frame}
        if len(set(frames.values())) < len(frames):
            said = ", ".join(f"{option} {name}" for option, name in frames.items())
            raise UserError(f"{said}: these are three frames, each needs a name of its own")
        if self.ros_config is not None and not self.ros_config.is_file():
            raise UserError(f"--ros-config {self.ros_config}: there is no such file")
        if self.scan_topic == self.odom_topic:
            raise UserError(f"--scan-topic and --odom-topic are both {self.scan_topic!r}: a topic has one type")

    def topic(self, name: str) -> str:
        """A topic's absolute name."""
        return full_name(name, self.namespace)

    def the_mount(self) -> Mount | None:
        """How the laser sits, where it was said."""
        if not self.mount:
            if self.upside_down:
                raise UserError("--upside-down goes with --mount x,y[,yaw_deg]: without it, tf says how the laser sits")
            return None
        x, y, yaw = map(float, pose_of_text(self.mount, "--mount"))
        return Mount((x, y, yaw), self.upside_down)
