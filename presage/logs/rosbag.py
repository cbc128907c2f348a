"""ROS 1 and 2 bags."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_typestore

from common.errors import UserError
from common.geometry.se2 import Array
from common.messages.ros_messages import Mount, plausible_time_increment, stamp_of
from common.robot.ranges import normalise_driver_ranges
from presage.logs.frame_history import FrameHistory
from presage.logs.log import Log, LoggedScan, Reading
from presage.logs.resampling import resample
from presage.logs.ros_poses import BagPoses, Lookup

SCAN = "sensor_msgs/msg/LaserScan"
ODOM = "nav_msgs/msg/Odometry"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSES = (ODOM, "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseStamped")


class Bag:
    """Access to the messages of one bag; errors in the file are raised as UserError."""

    def __init__(self, path: Path, kind: Literal["ros1", "ros2"]) -> None:
        """Uses the standard ROS definitions of the message types, not those in the bag."""
        self.path = path
        self._ros1 = kind == "ros1"
        # ROS 1 headers also have a sequence number. The ROS 1 store lacks tf2_msgs, which is the same in both.
        self._store = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        if self._ros1:
            self._store.register({TF[0]: get_typestore(Stores.ROS2_HUMBLE).fielddefs[TF[0]]})

    @contextlib.contextmanager
    def open(self) -> Iterator[Reader1 | Reader2]:
        """Opens the bag for reading in a `with` block."""
        with self._explained_errors(), Reader1(self.path) if self._ros1 else Reader2(self.path) as reader:
            yield reader

    def messages(self, reader: Reader1 | Reader2, connections: list[Connection]) -> Iterator[tuple[str, int, Any]]:
        """Yields (topic, time of logging in ns, message) of the given connections."""
        for connection, logged_ns, data in reader.messages(connections) if connections else ():
            name = TF[0] if connection.msgtype in TF else connection.msgtype
            read = self._store.deserialize_ros1 if self._ros1 else self._store.deserialize_cdr
            yield connection.topic, logged_ns, read(data, name)

    @contextlib.contextmanager
    def _explained_errors(self) -> Iterator[None]:
        try:
            yield
        except (UserError, KeyboardInterrupt, GeneratorExit):
            raise
        except Exception as error:  # noqa: BLE001 - damaged bags raise many kinds of errors
            reason = " ".join(str(error).split())[:160] or type(error).__name__
            raise UserError(
                f"{self.path}: a ROS bag that cannot be read ({reason}): cut short, damaged or not finished; `rosbag "
                "reindex`, `ros2 bag reindex` or `mcap recover` repair some of them"
            ) from None


@dataclass(frozen=True)
class _Topics:
    """The chosen connections."""

    scan: list[Connection]
    odom: list[Connection]
    tf: list[Connection]
    reference: list[Connection]


def open_rosbag(path: Path, kind: Literal["ros1", "ros2"], reading: Reading) -> Log:
    """Opens a ROS bag; raises UserError if it cannot be read, or if an option must choose among several topics."""
    bag, notes = Bag(path, kind), list[str]()
    with bag.open() as reader:
        topics = _choose_topics(path, reader.connections, reading)
        first = _first_scan(bag, reader, topics)
        by_logger = reading.clock == "logger" or not stamp_of(first.header)
        if by_logger and reading.clock == "sensor":
            notes.append("the scans have no stamps: the times of logging are used")
        poses = BagPoses(by_logger=by_logger)
        for topic, logged_ns, message in bag.messages(reader, [*topics.odom, *topics.tf, *topics.reference]):
            poses.add(topic, logged_ns, message)
        scans = sum(connection.msgcount for connection in topics.scan)
    laser = str(first.header.frame_id).lstrip("/")
    base = poses.base(laser, topics.odom, reading.base_frame)
    mount = _mount(path, poses.frames, base, laser, reading, notes)
    try:
        angles, reverse = _angles(first, flipped=mount.upside_down)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    log = Log(
        path,
        f"ROS {1 if kind == 'ros1' else 2} bag ({topics.scan[0].topic})",
        angles,
        np.array(mount.pose),
        reading.range_max or float(first.range_max),
        scans,
        lambda: iter(()),
        float(first.range_min),
        notes=notes,
        time_increment=plausible_time_increment(first) * (-1 if reverse else 1),
    )
    if not 0 < log.range_max < np.inf:
        raise UserError(
            f"{path}: the stated maximum range is {log.range_max:g} m: give range_max in section log of --config"
        )
    log.odometry, odom = poses.odometry(topics.odom, base, notes)
    log.reference, reference = poses.reference(topics.reference, base, reading, notes)
    topic, flipped = topics.scan[0].topic, mount.upside_down
    log.read = lambda: _read_scans(bag, log, topic, odom, reference, by_logger=by_logger, flipped=flipped)
    return log


def _choose_topics(path: Path, connections: list[Connection], reading: Reading) -> _Topics:
    def choose(types: tuple[str, ...], wanted: str, option: str) -> list[Connection]:
        found = {c.topic for c in connections if c.msgtype in types}
        # A reference topic may have the type Odometry too; it is not a candidate for the odometry.
        candidates = {wanted} if wanted else found - {reading.reference_topic}
        if wanted and wanted not in found:
            raise UserError(f"{path}: {option} {wanted}: no topic of that name and type; it has {_join(found)}")
        if len(candidates) > 1:
            raise UserError(
                f"{path}: several topics of type {types[0]}, choose one with {option} in section log "
                f"of --config: {_join(found)}"
            )
        return [c for c in connections if c.msgtype in types and c.topic in candidates]

    scan = choose((SCAN,), reading.scan_topic, "scan_topic")
    if not scan:
        raise UserError(f"{path}: no {SCAN} in it; it has {_join({c.msgtype for c in connections})}")
    reference = choose(POSES, reading.reference_topic, "reference_topic") if reading.reference_topic else []
    odom = choose((ODOM,), reading.odom_topic, "odom_topic")
    return _Topics(scan, odom, [c for c in connections if c.msgtype in TF], reference)


def _join(names: set[str]) -> str:
    return ", ".join(sorted(names)) or "nothing"


def _first_scan(bag: Bag, reader: Reader1 | Reader2, topics: _Topics) -> Any:
    found = next((message for _, _, message in bag.messages(reader, topics.scan) if len(message.ranges) > 2), None)
    if found is None:
        raise UserError(f"{bag.path}: {topics.scan[0].topic} has no scan with at least three beams")
    return found


def _mount(path: Path, frames: FrameHistory, base: str, laser: str, reading: Reading, notes: list[str]) -> Mount:
    """The mount given by the user, else from tf."""
    if reading.mount is not None:
        x, y, yaw = map(float, reading.mount)
        mount: Mount | None = Mount((x, y, yaw))
    else:
        mount = frames.mount(base, laser)
    if mount is None:
        raise UserError(
            f"{path}: tf does not state where {laser or 'the laser'} is mounted on {base}: give it with "
            "--mount x,y[,yaw_deg], or name another frame of the robot with base_frame in section log of --config"
        )
    flipped = mount.upside_down if reading.upside_down is None else reading.upside_down
    if flipped:
        notes.append("the scanner is mounted upside down: the order of its beams is reversed")
    return Mount(mount.pose, flipped)


def _angles(scan: Any, *, flipped: bool) -> tuple[Array, bool]:
    """Returns the beam angles (B,) rad, ascending, and whether the order of the ranges must be reversed.

    Raises ValueError if the angles of the scan make no sense.
    """
    start, step, beams = float(scan.angle_min), float(scan.angle_increment), len(scan.ranges)
    if step == 0 and beams > 1:  # some drivers do not fill in angle_increment
        step = (float(scan.angle_max) - start) / (beams - 1)
    if not (beams > 2 and np.isfinite([start, step]).all() and 0 < abs(step) * (beams - 1) <= 2 * np.pi + abs(step)):
        raise ValueError(f"impossible beam angles: {beams} beams from {start:g} rad on, {step:g} rad apart")
    angles = (start + step * np.arange(beams, dtype=np.float64)) * (-1 if flipped else 1)
    reverse = bool(angles[-1] < angles[0])
    return (angles[::-1] if reverse else angles), reverse


def _read_scans(
    bag: Bag, log: Log, topic: str, odom: Lookup, reference: Lookup, *, by_logger: bool, flipped: bool
) -> Iterator[LoggedScan]:
    resampled_scans = 0
    with bag.open() as reader:
        connections = [c for c in reader.connections if c.topic == topic and c.msgtype == SCAN]
        for _, logged_ns, scan in bag.messages(reader, connections):
            try:
                angles, reverse = _angles(scan, flipped=flipped)
            except ValueError:
                log.left_out["scans without beams"] += 1
                continue
            driver_ranges = np.asarray(scan.ranges[:: -1 if reverse else 1], np.float64)
            measured = normalise_driver_ranges(driver_ranges, log.range_min, log.range_max)
            ranges = resample(measured, angles, log.angles)
            if ranges is None:
                log.left_out["scans of other beams"] += 1
                continue
            resampled_scans += ranges is not measured
            stamp = logged_ns if by_logger else stamp_of(scan.header)
            yield LoggedScan(stamp, ranges, odom(stamp), reference(stamp))
    log.note_resampled(resampled_scans)
