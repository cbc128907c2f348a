"""Parses poses written as x,y[,yaw_deg]."""

from __future__ import annotations

import re

import numpy as np

from common.errors import PATTERN_PROBLEMS, UserError
from common.geometry.se2 import Array
from common.limits import MAX_COORDINATE_M

NUMBER_PATTERN = r"-?(\d{1,9}\.?\d*|\.\d+)"
POSE_PATTERN = rf"^$|^{NUMBER_PATTERN},{NUMBER_PATTERN}(,{NUMBER_PATTERN})?$"  # in settings, empty text means no pose
PATTERN_PROBLEMS[POSE_PATTERN] = "give x,y[,yaw_deg] in m and degrees, such as 0.2,0,180, not {input}"


def parse_pose(text: str, option: str) -> Array:
    """(3,) x, y in m and yaw in rad, which defaults to 0. Raises UserError, naming ``option``, for invalid text."""
    if not text or not re.fullmatch(POSE_PATTERN, text):
        raise UserError(f"{option} {text!r}: give x,y[,yaw_deg] in m and degrees, such as 0.2,0,180")
    x, y, *yaw = (float(part) for part in text.split(","))
    if max(abs(x), abs(y)) > MAX_COORDINATE_M:
        raise UserError(f"{option} {text!r}: x and y must be within {MAX_COORDINATE_M:g} m of the origin")
    return np.array([x, y, np.deg2rad(yaw[0]) if yaw else 0.0])


def parse_initial_pose(text: str, option: str) -> Array:
    """Like `parse_pose`, but returns (2,) x, y if the text has no yaw, which means that the heading is unknown."""
    has_yaw = text.count(",") == 2
    return parse_pose(text, option)[: 3 if has_yaw else 2]
