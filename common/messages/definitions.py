"""The messages published on topics.

Frames: `map` is fixed to the world, `odom` drifts, `base_link` is the robot's centre, `laser` the scanner.
A new field gets a default; a field never changes its type. docs/messages.md is generated from the docstrings and the
comments beside the fields.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.errors import UserError
from common.geometry.occupancy_grid import OccupancyGrid
from common.limits import Angle, Distance, PositiveAngle, PositiveDistance
from common.messages.pose import Pose as Pose  # noqa: PLC0414 - most modules import it from here
from common.messages.pose import Twist as Twist  # noqa: PLC0414
from common.messages.wire import (
    Bytes,
    Costs,
    Count,
    Finite,
    Floats,
    Matrix3,
    Message,
    Name,
    NotNegative,
    Points,
    Poses,
    ScanRanges,
    Text,
)
from common.robot.motion_distortion import beam_times, sweep_time

if TYPE_CHECKING:
    from common.geometry.world import World
    from common.robot.scanner import Scanner

GOAL_TOLERANCE_M = 0.02  # default of Goal.tolerance


class Stamped(Message):
    """Base of all messages on topics."""

    stamp_ns: Count  # ns, time of the measurement that this message is about (simulation or sensor time, not wall time)
    seq: Count = 0  # the publisher's counter for this key, from 0; a gap means loss


class Scan(Stamped):
    """One sweep of the scanner (sensor_msgs/LaserScan); its stamp is the time of the beam that was measured first."""

    angle_min: Angle  # rad, direction of the first beam in laser, counter-clockwise seen from above in any mounting
    angle_increment: Angle  # rad, between beams; negative if they run clockwise, as of a scanner mounted upside down
    range_min: Distance  # m
    range_max: PositiveDistance  # m
    ranges: ScanRanges  # (B,) m; +inf is nothing within range_max, -inf is too close (REP-117), 0 is not measured
    mount: Pose = Pose(x=0.0, y=0.0)  # pose of the scanner in base_link
    scan_time: NotNegative = 0.0  # s, between scans
    time_increment: Annotated[float, Field(ge=-1, le=1)] = 0.0  # s, between beams; negative if the last beam was
    # measured first; 0 if all were measured at the stamp, or if the times are unknown
    frame_id: Name = "laser"
    sigma: Distance = 0.0  # m, standard deviation of a range; unknown if this and sigma_relative are 0
    sigma_relative: Annotated[float, Field(ge=0, le=1)] = 0.0  # standard deviation as a share of the range,
    # added to sigma in quadrature

    @classmethod
    def of_scanner(cls, scanner: Scanner, ranges: npt.ArrayLike, stamp_ns: int, **fields: Any) -> Scan:
        """A scan with ``ranges`` (B,) m and the beams, limits and mount of a scanner; further fields by name."""
        return cls(
            stamp_ns=stamp_ns,
            angle_min=scanner.angle_min,
            angle_increment=scanner.angle_increment,
            range_min=scanner.range_min,
            range_max=scanner.range_max,
            ranges=np.asarray(ranges, np.float32),
            mount=Pose.of(scanner.mount),
            **fields,
        )

    def angles(self) -> npt.NDArray[np.float64]:
        """(B,) beam directions in laser, rad."""
        return self.angle_min + self.angle_increment * np.arange(len(self.ranges), dtype=np.float64)

    def beam_times(self) -> npt.NDArray[np.float64]:
        """(B,) times of the beams after the stamp, s."""
        return beam_times(len(self.ranges), self.time_increment)

    @property
    def sweep_time(self) -> float:
        """Time from the first beam to the last, s."""
        return sweep_time(len(self.ranges), self.time_increment)


class Odom(Stamped):
    """Dead reckoning (nav_msgs/Odometry)."""

    pose: Pose  # base_link in odom
    twist: Twist  # base_link
    covariance: Matrix3  # (3, 3) of x, y, yaw since the start; m², m rad, rad²
    frame_id: Name = "odom"


class Truth(Stamped):
    """The true state, which only a simulator knows."""

    pose: Pose  # base_link in map
    twist: Twist  # base_link
    contact: bool = False  # the robot touches something
    stopped: bool = False  # the obstacle stop slows or stops the robot
    people: Points = np.zeros((0, 2), np.float32)  # (K, 2) m in map, positions of people, who are in no map
    frame_id: Name = "map"


class BeliefHypothesis(Message):
    """One Gaussian of a belief's mixture."""

    pose: Pose  # base_link in map
    covariance: Matrix3 | None = None  # (3, 3) of x, y, yaw in map; nil if the estimator computes none
    weight: Annotated[float, Field(ge=0, le=1)]  # share of the mixture; the weights sum to 1

    @model_validator(mode="after")
    def _shape(self) -> BeliefHypothesis:
        if self.covariance is not None and self.covariance.shape != (3, 3):
            raise ValueError(f"covariance has shape {self.covariance.shape}, not (3, 3)")
        return self


class Belief(Stamped):
    """The estimator's posterior of the pose: one for each scan, with the stamp of the scan.

    Any estimator can publish it: what it does not compute stays nil.
    """

    state: Literal["localising", "tracking", "ambiguous", "lost"]  # precise: tracking if probability is at least 0.999,
    # else ambiguous if other hypotheses prevent that or one has over 5 %, else lost if it was tracking, else localising
    pose: Pose  # base_link in map
    covariance: Matrix3 | None = None  # (3, 3) of x, y, yaw in map; nil if the estimator computes none
    xi: Floats | None = None  # (3,) prediction error in pose space, xi = dg' Pi (o - g),
    # the negative gradient of accuracy in map: 1/m, 1/m, 1/rad (nats)
    curvature: Matrix3 | None = None  # (3, 3) dg' Pi dg, Gauss-Newton Hessian of F at the pose, map
    free_energy: Finite | None = None  # nats, accuracy + complexity
    accuracy: Finite | None = None  # nats, -ln p(o | pose)
    complexity: Finite | None = None  # nats, divergence of the posterior from the prior
    hypotheses: Annotated[list[BeliefHypothesis], Field(max_length=64)] = []  # noqa: RUF012
    # best first; the first one is at `pose`
    probability: Annotated[float, Field(ge=0, le=1)] | None = None  # that `pose` is within 0.2 m and 5 degrees of the
    # truth; nil if the estimator states none
    protection: Floats | None = None  # (3,) m along x and y of base_link, and rad: errors to be exceeded
    # once in 10^4 scans; nil if the estimator states none
    estimator: Name = ""
    field_version: Count = 0  # of the field that was learned while driving, see `field`; 0 is the original model
    frame_id: Name = "map"
    map_id: Name = ""  # the floor on which the pose is; empty between floors, and in a world without floors

    @model_validator(mode="after")
    def _shapes(self) -> Belief:
        for name in ("xi", "protection"):
            vector = getattr(self, name)
            if vector is not None and vector.shape != (3,):
                raise ValueError(f"{name} has shape {vector.shape}, not (3,)")
        for name in ("covariance", "curvature"):
            matrix = getattr(self, name)
            if matrix is not None and matrix.shape != (3, 3):
                raise ValueError(f"{name} has shape {matrix.shape}, not (3, 3)")
        return self


class Prediction(Stamped):
    """The scan that the estimator predicts for its belief, with the stamp of the measured scan."""

    angle_min: Angle  # rad, in laser
    angle_increment: Angle  # rad
    ranges: ScanRanges  # (B,) m, g(pose)
    sigma: Floats = np.zeros(0, np.float32)  # (B,) m, standard deviation of the ranges; empty if unknown
    frame_id: Name = "laser"


class Map(Stamped):
    """The map that the mapper has built so far; its origin is the place where mapping began."""

    grid: OccupancyGrid  # free, occupied and unknown cells
    poses: Poses  # (K, 3) base_link in map, of the key scans in order of time
    closures: Points = np.zeros((0, 2), np.float32)  # (2 C, 2) m in map, the two ends of each loop closure
    frame_id: Name = "map"


class LearnedField(Stamped):
    """A part of the distance field that the estimator has learned while driving, and uses for scans after the stamp."""

    version: Count  # from 1; all parts of a version have the same
    base: Name = ""  # SHA-256 of the original model's weights, hexadecimal; empty if it has none
    part: Annotated[int, Field(ge=0, lt=1000)] = 0  # index of this part
    parts: Annotated[int, Field(ge=1, le=1000)] = 1  # of this version
    data: Bytes  # all parts joined are the field's arrays in the format safetensors, compressed by zlib
    frame_id: Name = "map"


class Goal(Stamped):
    """The pose that the robot is to reach."""

    pose: Pose  # base_link in map, or in the frame of the floor map_id
    tolerance: PositiveDistance = GOAL_TOLERANCE_M  # m, the goal is reached within this distance
    yaw_tolerance: PositiveAngle | None = None  # rad, tolerance of the final heading; nil accepts any heading
    approach: Angle | None = None  # rad in map, direction of motion over the last 0.6 m; nil accepts any direction
    cancel: bool = False  # drop the goal, end an exploration, and stop
    explore: bool = False  # explore what is unknown in the mapper's map, and return; the pose is not used
    map_id: Name = ""  # the floor in whose frame pose and approach are; empty for map

    def in_map(self, world: World | None) -> Goal:
        """The same goal with its pose in map; raises UserError if ``world`` has no floor `map_id`."""
        if not self.map_id:
            return self
        if world is None:
            raise UserError(f"there is no floor {self.map_id!r}: there is no map with floors")
        pose = Pose.of(world.to_map(self.pose.array(), self.map_id))
        return self.model_copy(update={"pose": pose, "map_id": ""})

    def pose_in_map(self, world: World | None) -> Pose | None:
        """The goal's pose in map; None if ``world`` has no floor `map_id`, so that the controller refuses the goal."""
        try:
            return self.in_map(world).pose
        except UserError:
            return None


class Drive(Stamped):
    """A velocity steered by hand. It takes precedence over the goal for 0.5 s; repeat it to continue."""

    twist: Twist  # base_link; after 0.5 s of zeros, the robot drives to its goal again


class CmdVel(Stamped):
    """A velocity command; its stamp is that of the scan it responds to, so that its age is known."""

    twist: Twist  # base_link


class PolicyEnergy(Message):
    """Expected free energy of the chosen policy, in nats: risk + ambiguity - pose_information - place_information."""

    risk: Finite  # -ln p of the predicted states under the preferences: distance to go, gaps, change of velocity
    ambiguity: Finite  # expected entropy of the scans
    pose_information: Finite  # expected gain about where the robot is within a place; negative if motion loses more
    place_information: Finite  # expected gain about which of several places the robot is at
    probability: Annotated[float, Field(ge=0, le=1)]  # of the policy among those compared, by softmax(-5000 G)


class Exploration(Message):
    """Progress of the exploration of an unknown building."""

    phase: Literal["exploring", "returning", "finished", "failed"]  # finished: nothing is left to see, and the robot is
    # back where it began; failed: it cannot get back
    seq: Count  # of the goal that requested it
    area: NotNegative  # m², free space in the map
    path: NotNegative  # m, driven since it began


class Status(Stamped):
    """What the controller does, and why."""

    state: Literal["idle", "navigating", "reached", "blocked", "lost", "manual", "exploring"]
    # manual: driven by hand; exploring: moving to find out where the robot is, or what is unknown in the map
    reason: Text = ""
    refused: bool = False  # blocked permanently, as the goal cannot be reached; if false, the way may become free
    goal: Pose | None = None  # base_link in map
    goal_seq: Count = 0  # seq of the goal
    distance: Distance | None = None  # m, from the believed pose to the goal
    energy: PolicyEnergy | None = None  # of the chosen policy; nil without a policy, and with preset paper
    exploration: Exploration | None = None  # nil if none was requested, or the last one was cancelled


class Plan(Stamped):
    """The path that the controller plans, and the obstacles that are not in its map."""

    path: Points = np.zeros((0, 2), np.float32)  # (K, 2) m in map, from the believed position to the goal; may be empty
    motion: Points = np.zeros((0, 2), np.float32)  # (T, 2) m in map, positions under the command until it would stop
    obstacles: Points = np.zeros((0, 2), np.float32)  # (M, 2) m in map, measured by the scan and not in the map
    frame_id: Name = "map"


class Preference(Stamped):
    """The goal prior as a field over known free space; published when map, goal or obstacles change."""

    goal: Pose  # base_link in map
    origin: Pose  # lower left corner of the first cell, in map; yaw 0
    resolution: PositiveDistance  # m, edge length of a cell
    width: Annotated[int, Field(ge=1, le=4096)]  # cells along x
    height: Annotated[int, Field(ge=1, le=4096)]  # cells along y
    distance: Costs  # (height * width,) m, length of the path to the goal, row by row along x; +inf if unreachable
    frame_id: Name = "map"

    @model_validator(mode="after")
    def _shape(self) -> Preference:
        if len(self.distance) != self.width * self.height:
            raise ValueError(f"{len(self.distance)} distances for {self.height} rows of {self.width}")
        return self


class TopicHealth(Message):
    """Counters of one key in one service since its start."""

    key: Name
    received: Count = 0
    published: Count = 0
    dropped: Count = 0  # replaced by a newer one, by the topic's queue policy, or refused by a full queue
    undecodable: Count = 0
    written: Count = 0  # written to the recording; counted by the recorder only
    missing: Count = 0  # sent and never received, by the sequence numbers; counted by the recorder only
    rate: NotNegative = 0.0  # Hz over the last second


class Health(Stamped):
    """State and counters of a service, published once a second of wall time."""

    service: Name
    uptime: NotNegative  # s, wall time
    topics: list[TopicHealth] = []  # noqa: RUF012
    counters: dict[str, Count] = {}  # noqa: RUF012 - pydantic copies defaults
    note: Text = ""  # what the service waits for, or its last problem
    instance: Name = ""  # name of the process; each process numbers its own messages
    idle: bool = False  # publishes no results on purpose: paused, or waiting for something that the note names
