"""One drive through the corridor, and writers that put it into logs of every format."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from common.geometry import se2
from common.geometry.world import load_world

BEGAN_NS = 1_600_000_000_000_000_000
PERIOD_NS = 100_000_000
SCANS, BEAMS = 12, 91
RANGE_MAX = 25.0
MOUNT = np.array([0.1, 0.05, np.deg2rad(10)])
ANGLES = np.deg2rad(np.linspace(-90, 90, BEAMS))
STAMPS = BEGAN_NS + PERIOD_NS * np.arange(SCANS)


def truth(stamp_ns) -> np.ndarray:
    """(..., 3) base_link in map; straight, and turning at a constant rate, so that interpolation is exact."""
    seconds = (np.asarray(stamp_ns) - BEGAN_NS) * 1e-9
    return np.stack([4 + 0.5 * seconds, 1.5 + 0.1 * seconds, 1.2 + 0.2 * seconds], -1)


def believed(stamp_ns) -> np.ndarray:
    """(..., 3) base_link in map, as another localisation had it: it drifts by a decimetre a second."""
    seconds = (np.asarray(stamp_ns) - BEGAN_NS) * 1e-9
    return truth(stamp_ns) + 0.1 * seconds[..., None] * np.array([1, 0, 0])


START = np.array([3.5, 1.4, 0.4])  # where odometry began, in map


def odom(stamp_ns) -> np.ndarray:
    """(..., 3) base_link in odom, which does not drift."""
    return se2.between(START, truth(stamp_ns))


@functools.cache
def ranges() -> np.ndarray:
    """(SCANS, BEAMS) m, with noise."""
    exact = load_world("corridor").ray_distances(se2.compose(truth(STAMPS), MOUNT), ANGLES)
    return exact + 0.01 * np.random.default_rng(0).standard_normal(exact.shape)


def words(numbers) -> str:
    return " ".join(f"{number:.6f}" for number in np.asarray(numbers).ravel())


def carmen(kind: str = "ROBOTLASER1", *, corrected: bool = False, header: str = "") -> list[str]:
    """Lines with ODOM between the scans."""
    nothing = "0 0 0 0"
    lines = ["# CARMEN Logfile", "PARAM robot_front_laser_max 25.0 nohost 0", *([header] if header else [])]
    head = f"0 {ANGLES[0]:.8f} {ANGLES[-1] - ANGLES[0]:.8f} {ANGLES[1] - ANGLES[0]:.8f} {RANGE_MAX} 0.01 0"
    for k, (stamp, row) in enumerate(zip(STAMPS, ranges(), strict=True)):
        times = f"{stamp * 1e-9:.6f} host {k / 10:.6f}"
        robot, seen = odom(stamp), f"{BEAMS} {words(row)}"
        laser = se2.compose(truth(stamp) if corrected else robot, MOUNT)
        lines.append(f"ODOM {words(odom(stamp - 30_000_000))} 0.5 0.2 0 {stamp * 1e-9 - 0.03:.6f} host {k / 10:.6f}")
        lines.append({
            "FLASER": f"FLASER {seen} {words(laser)} {words(robot)} {times}",
            "ROBOTLASER1": f"ROBOTLASER1 {head} {seen} 0 {words(laser)} {words(robot)} {nothing} 0 {times}",
            "OLD": f"ROBOTLASER1 {head} {seen} {words(laser)} {words(robot)} {nothing} {times}",
            "RAWLASER1": f"RAWLASER1 {head} {seen} 2 1 1 {times}",
        }[kind])  # fmt: skip
    return lines


@dataclass(frozen=True)
class Bag:
    """What stands in a bag, and how."""

    form: str = "mcap"  # ros1, db3, mcap
    compression: str = ""  # file, message (ROS 2), bz2, lz4 (ROS 1)
    tf: bool = True  # base_link -> laser, static
    upside_down: bool = False
    localised: bool = False  # map -> odom in tf, which moves
    odom: bool = True
    more: tuple[str, ...] = ()  # further topics: scan2, ground_truth
    scan: dict = field(default_factory=dict)  # fields of LaserScan instead of the usual
    child: str = "base_link"  # of odometry
    each: Callable[[int], dict] = lambda _: {}  # the same, of the k-th

    def but(self, **changes) -> Bag:
        return replace(self, **changes)


def write_bag(folder: Path, bag: Bag) -> Path:
    """The file or, for several, the folder."""
    ros1 = bag.form == "ros1"
    path = folder / ("drive.bag" if ros1 else "drive")
    if ros1:
        writer = Writer1(path)
        if bag.compression:
            writer.set_compression(Writer1.CompressionFormat[bag.compression.upper()])
    else:
        plugin = StoragePlugin.MCAP if bag.form == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if bag.compression:
            writer.set_compression(CompressionMode[bag.compression.upper()], CompressionFormat.ZSTD)
    with writer:
        _Filler(writer, bag).fill()
    return path


class _Filler:
    """Messages of one bag."""

    def __init__(self, writer, bag: Bag) -> None:
        self.writer, self.bag = writer, bag
        self.ros1 = bag.form == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            self.store.register(
                {"tf2_msgs/msg/TFMessage": get_typestore(Stores.ROS2_HUMBLE).fielddefs["tf2_msgs/msg/TFMessage"]}
            )
        self.connections = {}

    def fill(self) -> None:
        roll = np.pi if self.bag.upside_down else 0.0
        if self.bag.tf:
            self.put("/tf_static", "tf2_msgs/msg/TFMessage", BEGAN_NS, transforms=[
                self.transform("base_link", "laser", BEGAN_NS, MOUNT, roll),
            ])  # fmt: skip
        for stamp in range(int(STAMPS[0]) - 90_000_000, int(STAMPS[-1]) + 100_000_000, 40_000_000):
            self.moving(stamp)
        for k, (stamp, row) in enumerate(zip(STAMPS.tolist(), ranges(), strict=True)):
            values = {
                "angle_min": ANGLES[0], "angle_max": ANGLES[-1], "angle_increment": ANGLES[1] - ANGLES[0],
                "time_increment": 0.0, "scan_time": 0.1, "range_min": 0.05, "range_max": RANGE_MAX,
                "ranges": (row[::-1] if self.bag.upside_down else row).astype(np.float32),
                "intensities": np.zeros(0, np.float32), **self.bag.scan, **self.bag.each(k),
            }  # fmt: skip
            header = self.header("laser", stamp)
            for topic in ("/scan", "/scan2")[: 2 if "scan2" in self.bag.more else 1]:
                self.put(topic, "sensor_msgs/msg/LaserScan", stamp + 20_000_000, header=header, **values)

    def moving(self, stamp: int) -> None:
        edges = [self.transform("odom", "base_link", stamp, odom(stamp))]
        if self.bag.localised:
            correction = se2.compose(believed(stamp), se2.inverse(odom(stamp)))
            edges.append(self.transform("map", "odom", stamp, correction))
        if self.bag.tf:
            self.put("/tf", "tf2_msgs/msg/TFMessage", stamp, transforms=edges)
        if self.bag.odom:
            self.odometry("/odom", stamp, odom(stamp))
        if "ground_truth" in self.bag.more:
            self.odometry("/ground_truth", stamp, truth(stamp))

    def odometry(self, topic: str, stamp: int, pose) -> None:
        t = self.store.types
        covariance, zero = np.zeros(36), t["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        with_covariance = t["geometry_msgs/msg/PoseWithCovariance"](self.pose(pose), covariance)
        twist = t["geometry_msgs/msg/TwistWithCovariance"](t["geometry_msgs/msg/Twist"](zero, zero), covariance)
        header = self.header("odom", stamp)
        self.put(
            topic, "nav_msgs/msg/Odometry", stamp, header=header, child_frame_id=self.bag.child, pose=with_covariance,
            twist=twist,
        )  # fmt: skip

    def pose(self, pose):
        t = self.store.types
        point = t["geometry_msgs/msg/Point"](float(pose[0]), float(pose[1]), 0.0)
        return t["geometry_msgs/msg/Pose"](point, self.quaternion(pose[2]))

    def quaternion(self, yaw: float, roll: float = 0.0):
        """Of yaw after roll."""
        a, b = yaw / 2, roll / 2
        parts = (np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.sin(a) * np.cos(b), np.cos(a) * np.cos(b))
        return self.store.types["geometry_msgs/msg/Quaternion"](*map(float, parts))

    def transform(self, parent: str, child: str, stamp: int, pose, roll: float = 0.0):
        t = self.store.types
        move = t["geometry_msgs/msg/Vector3"](float(pose[0]), float(pose[1]), 0.0)
        both = t["geometry_msgs/msg/Transform"](move, self.quaternion(pose[2], roll))
        return t["geometry_msgs/msg/TransformStamped"](self.header(parent, stamp), child, both)

    def header(self, frame: str, stamp: int):
        t = self.store.types
        time = t["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        return t["std_msgs/msg/Header"](0, time, frame) if self.ros1 else t["std_msgs/msg/Header"](time, frame)

    def put(self, topic: str, name: str, logged: int, **fields) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], logged, bytes(serialize(self.store.types[name](**fields), name)))
