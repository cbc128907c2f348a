"""Requests to queryables and their replies.

A new field gets a default; a field never changes its type. docs/messages.md is written from this file.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from common.geometry.world import Obstacle, World
from common.limits import MAX_BEAMS
from common.messages.pose import Pose
from common.messages.wire import Bytes, Count, Finite, Floats, Message, Name, NotNegative, Poses, Ranges, Text
from common.robot.base import Robot
from common.robot.scanner import Scanner


class Request(Message):
    """What a queryable is asked; this one needs nothing."""


class Reply(Message):
    """What a queryable answers."""

    ok: bool = True
    reason: Text = ""  # why not, where ok is false


class PoseRequest(Request):
    """Carry the robot, or the belief, to a pose."""

    pose: Pose  # base_link in map


class LocaliseRequest(Request):
    """Begin localisation anew, from a pose or from nothing."""

    pose: Pose | None = None  # base_link in map


class ResetRequest(Request):
    """Begin the simulation anew."""

    seed: Count | None = None  # None keeps the seed


class SpeedRequest(Request):
    """How fast the simulation's clock runs in realtime pace."""

    factor: Annotated[float, Field(allow_inf_nan=False, ge=0.1, le=20)]  # times wall time


class ObstacleRequest(Request):
    """Change the furniture of a running simulator."""

    action: Literal["add", "move", "remove"]
    name: Name
    obstacle: Obstacle | None = None  # for add and move, in map


class SampleRequest(Request):
    """Ask what the scanner would see from poses."""

    poses: Poses  # (N, 3) base_link in map
    beams: Annotated[int, Field(ge=2, le=MAX_BEAMS)] | None = None  # None: the scanner's own count
    noise: bool = False
    seed: Count = 0  # of the noise


class SampleReply(Reply):
    """Scans, row by row."""

    scanner: Scanner | None = None
    ranges: Ranges = np.zeros(0, np.float32)  # (N * B,) m, row-major


class PredictRequest(Request):
    """Ask the estimator what it expects the scanner to see from poses."""

    poses: Poses  # (N, 3) base_link in map, N at most 1000
    beams: Annotated[int, Field(ge=2, le=MAX_BEAMS)] | None = None  # of the scanner's, evenly chosen; None: all


class PredictReply(Reply):
    """Expected scans, row by row."""

    angles: Floats = np.zeros(0, np.float32)  # (B,) rad in laser
    ranges: Ranges = np.zeros(0, np.float32)  # (N * B,) m, row-major; +inf: no return expected
    sigma: Floats = np.zeros(0, np.float32)  # (N * B,) m, stated standard deviation; empty: none stated


class WorldReply(Reply):
    """What the scanner's side knows of itself."""

    world: World | None = None
    scanner: Scanner | None = None
    robot: Robot | None = None


class PlayerRequest(Request):
    """Steer a running replay."""

    action: Literal["pause", "resume", "step", "seek", "rate", "status"]  # step: to the end of the next scan, paused
    value: Finite = 0.0
    # seek: s from the recording's beginning; rate: times the original timing, 0 flat out; step: how many, at least 1


class PlayerReply(Reply):
    """Where a replay stands after the request."""

    paused: bool = False
    position_s: NotNegative = 0.0  # s from the recording's beginning
    duration_s: NotNegative = 0.0  # s, of the recording
    rate: NotNegative = 1.0  # times the original timing; 0: as fast as it goes
    loop: bool = False  # begins anew at its end


class RecordRequest(Request):
    """Begin or end a recording, or ask how it stands."""

    action: Literal["start", "stop", "status"]  # stop: the file is complete; start: a new one


class RecordReply(Reply):
    """How the recorder stands after the request."""

    recording: bool = False
    file: Text = ""  # path as the recorder sees it: the one being written, or the last one; empty: none yet
    messages: Count = 0  # in that recording
    seconds: NotNegative = 0.0  # s, wall time, since it was begun; once complete, from beginning to end


class ConfigReply(Reply):
    """Effective configuration and versions of a service."""

    service: Name = ""
    config: Text = ""  # JSON
    versions: dict[str, str] = {}  # noqa: RUF012
    protocol: Count = 0  # of its messages, `PROTOCOL` in common/versions.py; 0: not said
    host: Name = ""  # where it runs
    uptime: NotNegative = 0.0  # s, wall time, since its start


class ModelRequest(Request):
    """Ask the estimator what it was made of."""

    weights: bool = False  # with the weights themselves


class ModelReply(Reply):
    """What makes the estimator the very same again: its map, and the weights it loaded with their card."""

    estimator: Name = ""
    world: World | None = None  # the estimator's map
    card: Text = ""  # JSON, the model card; empty: nothing was learned
    file: Text = ""  # of the weights, NAME.safetensors, the card's is NAME.json; empty: nothing was learned
    size: Count = 0  # bytes of the weights
    sha256: Name = ""  # of the weights, hexadecimal
    weights: Bytes = np.zeros(0, np.uint8)  # the weights, where they were asked for
