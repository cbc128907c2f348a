"""The messages published on topics.

Frames: `map` is the world, `odom` drifts, `base_link` is the robot's centre, `laser` the scanner.
A new field gets a default; a field never changes its type. docs/messages.md is written from this file.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.limits import Angle, Distance, PositiveAngle, PositiveDistance
from common.messages.pose import Pose as Pose  # noqa: PLC0414 - most take it from here
from common.messages.pose import Twist as Twist  # noqa: PLC0414
from common.messages.wire import Beams, Costs, Count, Finite, Floats, Matrix3, Message, Name, NotNegative, Points, Text


class Stamped(Message):
    """What every topic's message begins with."""

    stamp_ns: Count  # ns, time of the measurement this message is about (simulation or sensor time, not wall time)
    seq: Count = 0  # counts the publisher's messages on this key, from 0; a gap is a loss


class Scan(Stamped):
    """One sweep of the scanner (sensor_msgs/LaserScan)."""

    angle_min: Angle  # rad, first beam, laser: counter-clockwise seen from above, however the scanner is mounted
    angle_increment: Angle  # rad, between beams; negative: they run clockwise, as of a scanner mounted upside down
    range_min: Distance  # m
    range_max: PositiveDistance  # m
    ranges: Beams  # (B,) m; +inf nothing within range_max, -inf too close (REP-117), 0 not measured
    mount: Pose = Pose(x=0.0, y=0.0)  # the scanner's pose in base_link
    scan_time: NotNegative = 0.0  # s, between scans
    frame_id: Name = "laser"
    sigma: Distance = 0.0  # m, standard deviation of a range; 0 with the next: not stated
    sigma_relative: Annotated[float, Field(ge=0, le=1)] = 0.0  # the part that grows with the range, in quadrature

    def angles(self) -> npt.NDArray[np.float64]:
        """(B,) rad, beam directions in laser."""
        return self.angle_min + self.angle_increment * np.arange(len(self.ranges), dtype=np.float64)


class Odom(Stamped):
    """Dead reckoning (nav_msgs/Odometry)."""

    pose: Pose  # base_link in odom
    twist: Twist  # base_link
    covariance: Matrix3  # (3, 3) of x, y, yaw since the start; m², m rad, rad²
    frame_id: Name = "odom"


class Truth(Stamped):
    """What only a simulator knows."""

    pose: Pose  # base_link in map
    twist: Twist  # base_link
    contact: bool = False  # the body touches something
    stopped: bool = False  # the obstacle stop holds the wheels back
    people: Points = np.zeros((0, 2), np.float32)  # (K, 2) m in map, where people stand; no map knows them
    frame_id: Name = "map"


class Hypothesis(Message):
    """One Gaussian of a belief's mixture."""

    pose: Pose  # base_link in map
    covariance: Matrix3 | None = None  # (3, 3) of x, y, yaw in map; None: this estimator has none
    weight: Annotated[float, Field(ge=0, le=1)]  # of the mixture, sums to 1

    @model_validator(mode="after")
    def _shape(self) -> Hypothesis:
        if self.covariance is not None and self.covariance.shape != (3, 3):
            raise ValueError(f"covariance has {self.covariance.shape}, not (3, 3)")
        return self


class Belief(Stamped):
    """The estimator's posterior about the pose, one for each scan, with that scan's stamp."""

    state: Literal["localising", "tracking", "ambiguous", "lost"]
    pose: Pose  # base_link in map
    covariance: Matrix3 | None = None  # (3, 3) of x, y, yaw in map; None: this estimator has none
    xi: Annotated[Floats, Field(description="prediction error in pose space")]
    # (3,) xi = dg' Pi (o - g), the negative gradient of accuracy in map: 1/m, 1/m, 1/rad (nats)
    curvature: Matrix3 | None = None  # (3, 3) dg' Pi dg, Gauss-Newton Hessian of F at the pose, map
    free_energy: Finite  # nats, accuracy + complexity
    accuracy: Finite  # nats, -ln p(o | pose)
    complexity: Finite = 0.0  # nats, how far the posterior is from the prior
    hypotheses: Annotated[list[Hypothesis], Field(max_length=64)] = []  # noqa: RUF012
    # best first: the first is the pose above
    estimator: Name = ""
    frame_id: Name = "map"

    @model_validator(mode="after")
    def _shapes(self) -> Belief:
        if self.xi.shape != (3,):
            raise ValueError(f"xi has {self.xi.shape}, not (3,)")
        for name in ("covariance", "curvature"):
            matrix = getattr(self, name)
            if matrix is not None and matrix.shape != (3, 3):
                raise ValueError(f"{name} has {matrix.shape}, not (3, 3)")
        return self


class Prediction(Stamped):
    """The scan the estimator expected, beam for beam beside the scan of the same stamp."""

    angle_min: Angle  # rad, laser
    angle_increment: Angle  # rad
    ranges: Beams  # (B,) m, g(pose)
    sigma: Floats = np.zeros(0, np.float32)  # (B,) m, stated standard deviation; empty: none stated
    frame_id: Name = "laser"


class Goal(Stamped):
    """Where the robot prefers to be."""

    pose: Pose  # base_link in map
    tolerance: PositiveDistance = 0.2  # m, reached within it
    yaw_tolerance: PositiveAngle | None = None  # rad, of the heading once it is there; None: any heading will do
    cancel: bool = False  # forget the goal and stand


class Drive(Stamped):
    """A velocity steered by hand; it goes before any goal, for 0.5 s unless said again."""

    twist: Twist  # base_link; zero for longer than 0.5 s: the goal counts again


class CmdVel(Stamped):
    """A velocity command; its stamp is that of the scan it answers, so that an old one is known as old."""

    twist: Twist  # base_link


class Status(Stamped):
    """What the controller is doing, and why."""

    state: Literal["idle", "navigating", "reached", "blocked", "lost", "manual", "exploring"]
    # manual: driven by hand; exploring: it moves to find out where it is
    reason: Text = ""
    refused: bool = False  # blocked for good: the goal cannot be; blocked otherwise, the way may clear
    goal: Pose | None = None  # base_link in map
    goal_seq: Count = 0  # which goal this is about
    distance: Distance | None = None  # m, from the believed pose to the goal


class Plan(Stamped):
    """The way the controller means to take, and what it knows that its map does not."""

    path: Points = np.zeros((0, 2), np.float32)  # (K, 2) m in map, from the believed place to the goal; empty: none
    motion: Points = np.zeros((0, 2), np.float32)  # (T, 2) m in map, where the command leads until it would stand
    obstacles: Points = np.zeros((0, 2), np.float32)  # (M, 2) m in map, seen by the scan and not in the map
    frame_id: Name = "map"


class Preference(Stamped):
    """The goal prior as a field over known free space; sent when map, goal or obstacles change."""

    goal: Pose  # base_link in map
    origin: Pose  # lower left corner of the first cell, in map; yaw 0
    resolution: PositiveDistance  # m, a cell's edge
    width: Annotated[int, Field(ge=1, le=4096)]  # cells along x
    height: Annotated[int, Field(ge=1, le=4096)]  # cells along y
    distance: Costs  # (height * width,) m to go with clearance, row by row along x; +inf: out of reach
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
    dropped: Count = 0  # older than the newest, by the topic's queue policy, or a full queue
    undecodable: Count = 0
    written: Count = 0  # into the recording; 0 in all but the recorder
    missing: Count = 0  # by the publisher's sequence numbers, sent and never received; counted by the recorder
    rate: NotNegative = 0.0  # Hz over the last second


class Health(Stamped):
    """A service's pulse, once a second of wall time."""

    service: Name
    uptime: NotNegative  # s, wall time
    topics: list[TopicHealth] = []  # noqa: RUF012
    counters: dict[str, Count] = {}  # noqa: RUF012 - pydantic copies defaults
    note: Text = ""  # what the service waits for or last complained of
    instance: Name = ""  # which process of the service; each numbers its own messages
