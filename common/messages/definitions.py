"""The messages published on topics.

Frames: `map` is fixed to the world, `odom` drifts, `base_link` is the centre of the robot's round outline, `laser` is
the scanner.
A new field gets a default; a field never changes its type. docs/messages.md is generated from the docstrings and the
comments above and beside the fields.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, Field, model_validator

from common.errors import UserError
from common.geometry.occupancy_grid import OccupancyGrid
from common.limits import MAX_FIELD_SIDE, Angle, Distance, PositiveAngle, PositiveDistance
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
# A message whose stamp is earlier than that of the last one by less is late; by more, time was reset.
MAX_LATE_NS = 1_000_000_000
COVARIANCE_ROUNDING = 1e-6  # of the largest element; more than what single precision loses


def _check_covariance(covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    if covariance.shape != (3, 3):
        raise ValueError(f"covariance has shape {covariance.shape}, not (3, 3)")
    relative = covariance / max(float(np.abs(covariance).max()), np.finfo(float).tiny)
    if (np.abs(relative - relative.T) > COVARIANCE_ROUNDING).any():
        raise ValueError("covariance is not symmetric")
    if (np.diagonal(covariance) < 0).any() or np.linalg.eigvalsh(relative)[0] < -COVARIANCE_ROUNDING:
        raise ValueError("covariance is not positive semidefinite")
    return covariance


Covariance = Annotated[Matrix3, AfterValidator(_check_covariance)]


class Stamped(Message):
    """Base of all messages on topics."""

    stamp_ns: Count  # ns, time of the measurement that this message is about
    seq: Count = 0  # the publisher's counter for this key, from 0; a gap means loss


class Scan(Stamped):
    """One sweep of the scanner (sensor_msgs/LaserScan); its stamp is the time of the beam that was measured first."""

    angle_min: Angle  # rad, first beam in laser, counter-clockwise seen from above in any mounting
    angle_increment: Angle  # rad, between beams, not 0; negative if they run clockwise, as of an upside-down scanner
    range_min: Distance  # m
    range_max: PositiveDistance  # m
    ranges: ScanRanges  # (B >= 2,) m; +inf is nothing within range_max, -inf too close (REP-117), 0 not measured
    mount: Pose = Pose(x=0.0, y=0.0)  # scanner in base_link
    scan_time: NotNegative = 0.0  # s, between scans
    # s, between beams; negative if the last was measured first; 0: at once, or unknown
    time_increment: Annotated[float, Field(ge=-1, le=1)] = 0.0
    frame_id: Name = "laser"
    sigma: Distance = 0.0  # m, standard deviation of a range; unknown if both sigmas are 0
    sigma_relative: Annotated[float, Field(ge=0, le=1)] = 0.0  # part proportional to the range, added in quadrature

    @model_validator(mode="after")
    def _has_directions(self) -> Scan:
        if len(self.ranges) < 2 or not self.angle_increment:
            raise ValueError(f"{len(self.ranges)} beams {self.angle_increment:g} rad apart: no scanner has those")
        return self

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
    covariance: Matrix3  # (3, 3) of x, y, yaw since the start
    frame_id: Name = "odom"


class Truth(Stamped):
    """The true state, which only a simulator knows."""

    pose: Pose  # base_link in map
    twist: Twist  # base_link
    contact: bool = False  # the robot touches something
    stopped: bool = False  # the obstacle stop reduced the commanded velocity
    people: Points = np.zeros((0, 2), np.float32)  # (K, 2) m in map
    frame_id: Name = "map"


class BeliefHypothesis(Message):
    """One Gaussian of a belief's mixture."""

    pose: Pose  # base_link in map
    covariance: Covariance | None = None  # (3, 3) of x, y, yaw in map, positive semidefinite
    weight: Annotated[float, Field(ge=0, le=1)]  # the weights sum to 1


class Belief(Stamped):
    """The estimator's posterior of the pose: one for each scan, with the stamp of the scan.

    Any estimator can publish it: what it does not compute stays nil.
    """

    # tracking: the pose is known; ambiguous: several poses are plausible; lost: the pose was known; localising: not yet
    state: Literal["localising", "tracking", "ambiguous", "lost"]
    pose: Pose  # base_link in map
    covariance: Covariance | None = None  # (3, 3) of x, y, yaw in map, positive semidefinite
    xi: Floats | None = None  # (3,) dg' Pi (o - g), the negative gradient of accuracy in map: nats/m, nats/m, nats/rad
    curvature: Matrix3 | None = None  # (3, 3) dg' Pi dg, Gauss-Newton Hessian of accuracy in map
    free_energy: Finite | None = None  # nats, accuracy + complexity
    accuracy: Finite | None = None  # nats, negative log-likelihood -ln p(o | pose): smaller is better
    complexity: Finite | None = None  # nats, divergence of the posterior from the prior
    # best first; the first one is at `pose`
    hypotheses: Annotated[list[BeliefHypothesis], Field(max_length=64)] = []  # noqa: RUF012
    probability: Annotated[float, Field(ge=0, le=1)] | None = None  # that `pose` is within 0.2 m and 5 deg of the truth
    protection: Floats | None = None  # (3,) m, m, rad in base_link: error bounds, exceeded in 1 of 10^4 scans
    estimator: Name = ""
    field_version: Count = 0  # of the LearnedField; 0: original model
    frame_id: Name = "map"
    map_id: Name = ""  # floor of the pose; empty between floors, or without floors

    @model_validator(mode="after")
    def _shapes(self) -> Belief:
        for name in ("xi", "protection"):
            vector = getattr(self, name)
            if vector is not None and vector.shape != (3,):
                raise ValueError(f"{name} has shape {vector.shape}, not (3,)")
        if self.curvature is not None and self.curvature.shape != (3, 3):
            raise ValueError(f"curvature has shape {self.curvature.shape}, not (3, 3)")
        return self


class Prediction(Stamped):
    """The scan that the estimator predicts for its belief, with the stamp of the measured scan."""

    angle_min: Angle  # rad, in laser
    angle_increment: Angle  # rad
    ranges: ScanRanges  # (B,) m, g(pose)
    sigma: Floats = np.zeros(0, np.float32)  # (B,) m, standard deviations; empty: unknown
    frame_id: Name = "laser"


class Map(Stamped):
    """The map that the mapper has built so far; the origin of the frame map is where mapping began."""

    grid: OccupancyGrid  # occupied, free and unknown cells
    poses: Poses  # (K, 3) base_link in map, key scans in order of time
    closures: Points = np.zeros((0, 2), np.float32)  # (2 C, 2) m in map, both ends of each loop closure
    # (N,) 1 for each key scan so far that is connected to the map, and so in poses, else 0; empty: all are
    connected: Bytes = np.zeros(0, np.uint8)
    frame_id: Name = "map"

    @property
    def key_scans(self) -> int:
        """Number of key scans so far, connected to the map or not."""
        return len(self.connected) or len(self.poses)

    @property
    def numbers(self) -> npt.NDArray[np.intp]:
        """Number (K,) of each key scan in `poses`: its index among all so far, the same in all versions of the map."""
        return np.flatnonzero(self.connected) if len(self.connected) else np.arange(len(self.poses))

    @model_validator(mode="after")
    def _shape(self) -> Map:
        if len(self.numbers) != len(self.poses):
            raise ValueError(f"{len(self.poses)} poses of {len(self.numbers)} connected key scans")
        return self


class LearnedField(Stamped):
    """A part of the distance field that the estimator has learned while driving, and uses for scans after the stamp."""

    version: Count  # from 1
    base: Name = ""  # SHA-256 of the original model's weights, hexadecimal
    part: Annotated[int, Field(ge=0, lt=1000)] = 0  # index, from 0
    parts: Annotated[int, Field(ge=1, le=1000)] = 1  # of this version
    data: Bytes  # the joined parts are safetensors, compressed by zlib
    frame_id: Name = "map"


class Goal(Stamped):
    """The pose that the robot is to reach."""

    pose: Pose  # base_link in the frame of map_id
    tolerance: PositiveDistance = GOAL_TOLERANCE_M  # m
    yaw_tolerance: PositiveAngle | None = None  # rad; nil accepts any heading
    approach: Angle | None = None  # rad, direction of the last 0.6 m of motion; nil accepts any
    cancel: bool = False  # end driving and exploring
    explore: bool = False  # explore what the mapper's map lacks, and return; ignores pose
    map_id: Name = ""  # a floor; empty: map

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
    """A velocity steered by hand."""

    twist: Twist  # base_link; overrides the goal until no message, or only zero velocity, has arrived for 0.5 s


class CmdVel(Stamped):
    """A velocity command; its stamp is that of the scan it responds to, so that its age is known."""

    twist: Twist  # base_link


class PolicyEnergy(Message):
    """Expected free energy of the chosen motion, in nats: risk + ambiguity - pose_information - place_information."""

    risk: Finite  # of distance to go, closeness to obstacles and changes of velocity
    # entropy of the pose expected along the way; with several hypotheses, mean entropy of the beams predicted at the
    # end of the way
    ambiguity: Finite
    pose_information: Finite  # expected gain about the pose within a place; negative: a loss
    place_information: Finite  # expected gain about which hypothesis is true
    probability: Annotated[float, Field(ge=0, le=1)]  # among the motions compared, softmax(-5000 G)


class Exploration(Message):
    """Progress of the exploration of an unknown building."""

    # finished: all is seen, and the robot is back; failed: it cannot get back, or cannot plan a path to what is left;
    # the status says why
    phase: Literal["exploring", "returning", "finished", "failed"]
    seq: Count  # of the goal that requested it
    area: NotNegative  # m², free space in the map
    path: NotNegative  # m, driven since it began


class Status(Stamped):
    """What the controller does, and why."""

    # exploring: to find its pose, or unknown space
    state: Literal["idle", "navigating", "reached", "blocked", "lost", "manual", "exploring"]
    reason: Text = ""
    refused: bool = False  # the goal cannot be reached; else, blocked is temporary
    goal: Pose | None = None  # base_link in map
    goal_seq: Count = 0  # seq of the goal
    distance: Distance | None = None  # m, from the believed pose to the goal
    energy: PolicyEnergy | None = None  # preset geodesic
    exploration: Exploration | None = None  # nil: none, or cancelled


class Plan(Stamped):
    """The path that the controller plans, and the obstacles that are not in its map."""

    path: Points = np.zeros((0, 2), np.float32)  # (K, 2) m in map, from the believed position to the goal
    motion: Points = np.zeros((0, 2), np.float32)  # (T, 2) m in map, motion until the robot would stop
    obstacles: Points = np.zeros((0, 2), np.float32)  # (M, 2) m in map
    frame_id: Name = "map"


class Preference(Stamped):
    """The goal prior as a field over known free space; published when map, goal or obstacles change."""

    goal: Pose  # base_link in map
    origin: Pose  # lower left corner of the grid, in map; yaw 0
    resolution: PositiveDistance  # m, edge length of a cell
    width: Annotated[int, Field(ge=1, le=MAX_FIELD_SIDE)]  # cells along x
    height: Annotated[int, Field(ge=1, le=MAX_FIELD_SIDE)]  # cells along y
    # (height * width,) m, cost of the path to the goal: its length, where metres near walls or without knowing the pose
    # count more; row by row along x; +inf: unreachable
    distance: Costs
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
    dropped: Count = 0  # replaced by a newer one, or the queue was full
    undecodable: Count = 0
    written: Count = 0  # to the recording
    missing: Count = 0  # lost, by sequence numbers; counted by the recorder only
    rate: NotNegative = 0.0  # Hz over the last second


class Health(Stamped):
    """State and counters of a service, published once a second of wall time."""

    service: Name
    uptime: NotNegative  # s, wall time
    topics: list[TopicHealth] = []  # noqa: RUF012
    # numbers by name; each service has its own
    counters: dict[str, Count] = {}  # noqa: RUF012 - pydantic copies defaults
    note: Text = ""  # what the service waits for, or its last problem
    instance: Name = ""  # name of the process; each process counts its own seq
    idle: bool = False  # publishes no results on purpose, see note
