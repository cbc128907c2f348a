"""Requests to queryables and their replies.

A new field gets a default; a field never changes its type. docs/messages.md is generated from the docstrings and the
comments above and beside the fields.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from common.geometry.world import Obstacle, World
from common.limits import MAX_BEAMS
from common.messages.pose import Pose
from common.messages.wire import Bytes, Count, Finite, Floats, Message, Name, NotNegative, Poses, Ranges, Text
from common.robot.robot import Robot
from common.robot.scanner import Scanner

FILE_NAME = r"[A-Za-z0-9_-]{1,64}"  # under which maps and models may be saved


class Request(Message):
    """Base of all requests, and a request without parameters."""


class Reply(Message):
    """Base of all replies, and a reply without data."""

    ok: bool = True
    reason: Text = ""  # why the request failed


class PoseRequest(Request):
    """Move the robot to a pose."""

    pose: Pose  # base_link in the frame of map_id
    map_id: Name = ""  # a floor; empty: map


class LocaliseRequest(Request):
    """Restart localisation, from a known pose or globally."""

    pose: Pose | None = None  # base_link in the frame of map_id; nil: anywhere (preset paper: its initial pose)
    heading_known: bool = True  # false: pose.yaw is unknown
    map_id: Name = ""  # a floor; empty: map


class ResetRequest(Request):
    """Restart the simulation."""

    seed: Count | None = None  # nil keeps the seed


class SpeedRequest(Request):
    """Set the speed of the clock of a simulator whose setting `pace` is `realtime`."""

    factor: Annotated[float, Field(allow_inf_nan=False, ge=0.1, le=20)]  # times real time


class ObstacleRequest(Request):
    """Change the furniture of a running simulator."""

    action: Literal["add", "move", "remove"]
    name: Name
    obstacle: Obstacle | None = None  # shape in map, for add and move


class SampleRequest(Request):
    """Simulate scans from given poses."""

    poses: Poses  # (N, 3) base_link in map
    beams: Annotated[int, Field(ge=2, le=MAX_BEAMS)] | None = None  # nil: the scanner's own
    noise: bool = False
    seed: Count = 0  # random seed of the noise


class SampleReply(Reply):
    """The simulated scans."""

    scanner: Scanner | None = None
    ranges: Ranges = np.zeros(0, np.float32)  # (N * B,) m, row-major


class PredictRequest(Request):
    """Predict scans from given poses with the estimator's model."""

    poses: Poses  # (N, 3) base_link in map, N ≤ 1000
    beams: Annotated[int, Field(ge=2, le=MAX_BEAMS)] | None = None  # at most; evenly spaced; nil: all


class PredictReply(Reply):
    """The predicted scans."""

    angles: Floats = np.zeros(0, np.float32)  # (B,) rad in laser
    ranges: Ranges = np.zeros(0, np.float32)  # (N * B,) m, row-major; +inf: no return
    sigma: Floats = np.zeros(0, np.float32)  # (N * B,) m, standard deviations; empty: unknown


class WorldReply(Reply):
    """The simulator's world, scanner and robot."""

    world: World | None = None
    scanner: Scanner | None = None
    robot: Robot | None = None


class PlayerRequest(Request):
    """Control a running replay."""

    action: Literal["pause", "resume", "step", "seek", "rate", "status"]  # step plays to the end of a scan and pauses
    # seek: s from the start; rate: times the original speed, 0: maximum; step: number of scans
    value: Finite = 0.0


class PlayerReply(Reply):
    """State of the replay after the request."""

    paused: bool = False
    position_s: NotNegative = 0.0  # s from the start
    duration_s: NotNegative = 0.0  # s
    rate: NotNegative = 1.0  # times the original speed; 0: maximum
    loop: bool = False  # the replay repeats


class RecordRequest(Request):
    """Start or stop a recording, or query its state."""

    action: Literal["start", "stop", "status"]  # stop completes the file, start begins a new one


class RecordReply(Reply):
    """State of the recorder after the request."""

    recording: bool = False
    file: Text = ""  # present or last recording, on the recorder's machine
    messages: Count = 0  # in that file
    seconds: NotNegative = 0.0  # s of wall time, length so far


class SaveMapRequest(Request):
    """Write the map as NAME.yaml, with the image NAME.pgm and the trajectory NAME.tum."""

    name: Name  # letters, digits, - and _


class SaveMapReply(Reply):
    """The world that was written."""

    file: Text = ""  # NAME.yaml on the mapper's machine


class SaveModelRequest(Request):
    """Write the model learned while driving as NAME-precise.safetensors, with its card NAME-precise.json."""

    name: Name  # letters, digits, - and _


class SaveModelReply(Reply):
    """The model that was written."""

    file: Text = ""  # NAME-precise.safetensors on the estimator's machine
    version: Count = 0


class ConfigReply(Reply):
    """Effective configuration and versions of a service."""

    service: Name = ""
    config: Text = ""  # the settings as JSON
    # of Python and packages, by name
    versions: dict[str, str] = {}  # noqa: RUF012
    protocol: Count = 0  # version of the messages; 0: unknown
    host: Name = ""
    uptime: NotNegative = 0.0  # s of wall time


class ModelRequest(Request):
    """Query the estimator's map and weights."""

    weights: bool = False


class ModelReply(Reply):
    """Everything needed to rebuild the estimator: its map, and the weights it loaded with their model card."""

    estimator: Name = ""
    world: World | None = None  # the estimator's map
    card: Text = ""  # model card as JSON; empty: no weights
    file: Text = ""  # NAME.safetensors; the card is NAME.json
    size: Count = 0  # bytes of the weights
    sha256: Name = ""  # of the weights, hexadecimal
    weights: Bytes = np.zeros(0, np.uint8)  # if requested
