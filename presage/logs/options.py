"""Properties of a log that its file does not state: section `log` of a settings file."""

from __future__ import annotations

import re
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from common.errors import UserError
from common.geometry.pose_text import NUMBER_PATTERN, POSE_PATTERN, parse_pose
from common.limits import MAX_RANGE_M
from presage.logs.log import Reading


class LogSettings(BaseModel):
    """If a setting is empty or None, the value in the log is used."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    mount: Annotated[str, Field(pattern=POSE_PATTERN)] = ""  # x,y[,yaw_deg] of the laser in base_link, m and deg
    upside_down: bool | None = None  # the scanner is mounted with a roll of 180 deg
    # Whose poses are estimated or recorded, and which the poses in an .npz file are of.
    frame: Literal["base_link", "laser"] = "base_link"
    scan_topic: str = ""  # if there are several; in a CARMEN log the type of line, such as RLASER
    odom_topic: str = ""  # if there are several; in a CARMEN log ODOM reads the ODOM lines
    odometry: bool = True  # whether `presage localize` uses the odometry
    base_frame: str = ""  # frame of the robot in tf
    reference: bool | None = None  # false reads no reference poses; true also those of corrected CARMEN scans
    reference_topic: str = ""  # Odometry, PoseStamped or PoseWithCovarianceStamped in the map
    angles: str = ""  # of the first and last beam in deg, such as -90,90
    range_max: Annotated[float, Field(ge=0.1, le=MAX_RANGE_M)] | None = None  # m; longer ranges mean no return
    clock: Literal["sensor", "logger"] = "sensor"  # which stamps are used
    rate: Annotated[float, Field(ge=0.01, le=1000)] | None = None  # Hz, scan rate of a log without stamps
    sigma: Annotated[float, Field(ge=1e-4, le=10)] | None = None  # m, range noise of the scanner

    def reading(self) -> Reading:
        """The options for reading the log; raises UserError if the angles are malformed."""
        return Reading(
            parse_pose(self.mount, "--mount") if self.mount else None,
            self.scan_topic,
            self.odom_topic,
            self.base_frame,
            self.upside_down,
            self.reference,
            self.reference_topic,
            angles_of(self.angles) if self.angles else None,
            self.range_max,
            self.clock,
        )


def angles_of(text: str) -> tuple[float, float]:
    """Angles of the first and last beam, rad, from text FIRST,LAST in degrees; raises UserError if malformed."""
    if not re.fullmatch(f"{NUMBER_PATTERN},{NUMBER_PATTERN}", text):
        raise UserError(f"angles {text!r}: give the angles of the first and the last beam in degrees, such as -90,90")
    first, last = (float(np.deg2rad(float(part))) for part in text.split(","))
    if not 0 < last - first <= 2 * np.pi:
        raise UserError(f"angles {text!r}: the last beam must lie up to 360 degrees to the left of the first")
    return first, last
