"""A simulated ROS 2 robot: base and scanner in the corridor, with the protocol of rmw_zenoh or zenoh-bridge-ros2dds.

It shares no code with the bridge: keys, tokens and attachments are written out here, and the CDR encoding is
independent. Five times a second it prints its state and what it received as JSON.
"""

from __future__ import annotations

import argparse
import json
import signal
import struct
import threading
import time

import numpy as np
import zenoh
import zenoh.ext
from typing_extensions import Self

from common.geometry.world import load_world
from common.messages.definitions import Twist
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from services.simulator.simulation import Simulation, SimulationSetup
from tests.bridge_ros2.cdr import (
    decode,
    encode,
    header,
    laser_scan,
    odometry,
    planar_pose,
    quaternion,
    vector,
)

HASHES = {
    "sensor_msgs::msg::dds_::LaserScan_": "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "nav_msgs::msg::dds_::Odometry_": "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "tf2_msgs::msg::dds_::TFMessage_": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "geometry_msgs::msg::dds_::Twist_": "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "geometry_msgs::msg::dds_::TwistStamped_": (
        "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"
    ),
    "geometry_msgs::msg::dds_::PoseStamped_": "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_": (
        "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
    ),
}
BEGIN = 1_700_000_000 * 10**9  # ns, the robot's clock when it starts
MOUNT = (0.2, 0.0, 0.0)  # of the laser in base_link; upside down, turned about its own x axis
QOS = {"scan": "2::,5:,:,:,,", "tf_static": ":1:,1:,:,:,,", "amcl_pose": ":1:,1:,:,:,,"}


class Ros:
    """A ROS 2 node, using rmw_zenoh or zenoh-bridge-ros2dds."""

    def __init__(self, port: int, flavor: str, distro: str) -> None:
        self.rmw, self.humble = flavor == "rmw_zenoh", distro == "humble"
        config = zenoh.Config()
        for key, value in {
            "mode": "peer", "connect/endpoints": [f"tcp/127.0.0.1:{port}"], "listen/endpoints": ["tcp/127.0.0.1:0"],
            "scouting/multicast/enabled": False, "transport/shared_memory/enabled": False,
        }.items():  # fmt: skip
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.zid = str(self.session.zid())
        self.kept, self.sequence = [], 0
        if self.rmw:
            self.token(f"@ros2_lv/0/{self.zid}/0/0/NN/%/%/robot")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_) -> None:
        self.session.close()

    def token(self, key: str) -> None:
        self.kept.append(self.session.liveliness().declare_token(key))

    def declare(self, kind: str, topic: str, dds: str) -> str:
        """Declares a publisher or subscriber with a liveliness token. Returns its zenoh key."""
        if not self.rmw:
            package, _, _, name = dds.split("::")
            self.token(f"@/{self.zid}/@ros2_lv/{kind}/{topic}/{package}§msg§{name.removesuffix('_')}/:::")
            return topic
        digest = "TypeHashNotSupported" if self.humble else HASHES[dds]
        number, qos = len(self.kept), QOS.get(topic, "::,10:,:,:,,")
        self.token(f"@ros2_lv/0/{self.zid}/0/{number}/{kind}/%/%/robot/%{topic}/{dds}/{digest}/{qos}")
        return f"0/{topic}/{dds}/{digest}"

    def publisher(self, topic: str, dds: str):
        key, static = self.declare("MP", topic, dds), topic == "tf_static"
        if not static:
            made = self.session.declare_publisher(key)
        elif self.rmw:
            made = zenoh.ext.declare_advanced_publisher(
                self.session, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            )  # fmt: skip
        else:  # the bridge's cache answers on a separate key
            made, last = self.session.declare_publisher(key), []

            def answer(query: zenoh.Query) -> None:
                for payload in last[-1:]:
                    query.reply(key, payload)

            self.kept.append(self.session.declare_queryable(f"@/{self.zid}/@ros2_pub_cache/{key}", answer))
            self.kept.append(made)
            return lambda payload: (last.append(payload), made.put(payload))
        self.kept.append(made)
        return lambda payload: made.put(payload, **self.attached())

    def attached(self) -> dict:
        if not self.rmw:
            return {}
        self.sequence += 1
        return {"attachment": struct.pack("<qqB16s", self.sequence, time.time_ns(), 16, b"0123456789abcdef")}

    def subscribe(self, topic: str, dds: str, hear) -> None:
        name = dds.replace("::msg::dds_::", "/msg/").removesuffix("_")

        def move(sample: zenoh.Sample) -> None:
            data = sample.attachment.to_bytes() if sample.attachment is not None else b""
            if self.rmw and (len(data) != 33 or data[16] != 16):
                raise ValueError(f"{topic}: an attachment of {len(data)} bytes, which crashes rmw_zenoh")
            hear(decode(name, sample.payload.to_bytes()))

        self.kept.append(self.session.declare_subscriber(self.declare("MS", topic, dds), move))


class StandIn:
    """The base, its scanner and the messages it receives. The simulation's own watchdog of 0.2 s is active."""

    def __init__(self, ros: Ros, *, stamped: bool) -> None:
        scanner = SCANNERS["tim571"].with_beams(622).model_copy(update={"mount": MOUNT})
        # Without the simulator's obstacle stop, because the bridge's is tested.
        self.simulation = Simulation(
            SimulationSetup(load_world("corridor"), scanner, Robot(), None, 3, obstacle_stop=False)
        )
        self.lock = threading.Lock()
        self.heard = {"commands": 0, "zeros": 0, "transforms": 0, "pose": None, "odom_in_map": None}
        twist = "geometry_msgs::msg::dds_::TwistStamped_" if stamped else "geometry_msgs::msg::dds_::Twist_"
        ros.subscribe("cmd_vel", twist, self.drive)
        ros.subscribe("amcl_pose", "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_", self.hear_pose)
        ros.subscribe("tf", "tf2_msgs::msg::dds_::TFMessage_", self.hear_tf)
        put_static = ros.publisher("tf_static", "tf2_msgs::msg::dds_::TFMessage_")
        self.put_tf = ros.publisher("tf", "tf2_msgs::msg::dds_::TFMessage_")
        self.put_odom = ros.publisher("odom", "nav_msgs::msg::dds_::Odometry_")
        self.put_scan = ros.publisher("scan", "sensor_msgs::msg::dds_::LaserScan_")
        put_static(
            transforms(
                transform("base_footprint", "base_link", 0, 0, 0.1, quaternion(), BEGIN),
                transform("base_link", "laser", MOUNT[0], MOUNT[1], 0.2, quaternion(1, 0, 0, 0), BEGIN),
            )
        )

    def drive(self, message) -> None:
        twist = getattr(message, "twist", message)
        x, y, turn = float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)
        with self.lock:
            self.heard["commands"] += 1
            self.heard["zeros"] += not (x or y or turn)
            self.simulation.command(self.simulation.stamp_ns, Twist(vx=x, vy=y, wz=turn))

    def hear_pose(self, message) -> None:
        pose = message.pose.pose
        yaw = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
        self.heard["pose"] = [pose.position.x, pose.position.y, yaw]

    def hear_tf(self, message) -> None:
        for each in message.transforms:
            if (each.header.frame_id, each.child_frame_id) == ("map", "odom"):
                at, turn = each.transform.translation, each.transform.rotation
                self.heard["transforms"] += 1
                self.heard["odom_in_map"] = [at.x, at.y, 2 * np.arctan2(turn.z, turn.w)]

    def step(self) -> dict:
        """Advances by one scan and publishes the measurements. Returns the true state for the test."""
        with self.lock:
            self.simulation.advance()
            odom, truth, scan = self.simulation.observe()
        stamp, pose = BEGIN + scan.stamp_ns, planar_pose(*odom.pose.array())
        turn = pose["orientation"]
        self.put_tf(transforms(transform("odom", "base_footprint", odom.pose.x, odom.pose.y, 0, turn, stamp)))
        self.put_odom(odometry(stamp, pose, odom.twist.array(), "base_footprint"))
        # The scanner is mounted upside down, so the first beam is the leftmost. It reports no return as 0.
        ranges = np.where(np.isposinf(scan.ranges), 0, scan.ranges)[::-1]
        limits = {"range_min": scan.range_min, "range_max": scan.range_max, "scan_time": 1 / 15}
        angles = {"angle_min": scan.angle_min, "angle_max": -scan.angle_min, "angle_increment": scan.angle_increment}
        self.put_scan(laser_scan(stamp, ranges.tolist(), **angles, **limits))
        speed = float(np.hypot(truth.twist.vx, truth.twist.vy))
        odom_pose = odom.pose.array().tolist()
        true = {"truth": truth.pose.array().tolist(), "speed": speed, "contact": truth.contact, "odom": odom_pose}
        return {**true, **self.heard}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--flavor", default="rmw_zenoh")
    parser.add_argument("--distro", default="jazzy")
    parser.add_argument("--stamped", action="store_true")
    options = parser.parse_args()
    done = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: done.set())
    with Ros(options.port, options.flavor, options.distro) as ros:
        robot = StandIn(ros, stamped=options.stamped)
        due, reported = time.monotonic(), 0.0
        while not done.wait(max(0.0, due - time.monotonic())):
            now = robot.step()
            due = max(due + 1 / 15, time.monotonic() - 0.2)
            if time.monotonic() >= reported + 0.2:
                reported = time.monotonic()
                print(json.dumps(now), flush=True)
    robot.simulation.close()


def transform(parent: str, child: str, x: float, y: float, z: float, rotation: dict, stamp: int) -> dict:
    return {
        "header": header(stamp, parent), "child_frame_id": child,
        "transform": {"translation": vector(x, y, z), "rotation": rotation},
    }  # fmt: skip


def transforms(*each: dict) -> bytes:
    return encode("tf2_msgs/msg/TFMessage", {"transforms": list(each)})


if __name__ == "__main__":
    main()
