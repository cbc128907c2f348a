"""Parses poses written as x,y[,yaw_deg]."""

from __future__ import annotations

import re

import numpy as np

from common.errors import UserError
from common.geometry.se2 import Array
from common.limits import MAX_COORDINATE_M

NUMBER = r"-?(\d{1,9}\.?\d*|\.\d+)"
POSE_TEXT = rf"^$|^{NUMBER},{NUMBER}(,{NUMBER})?$"  # the empty text is allowed, too


def start_of_text(text: str, option: str) -> Array:
    """(3,) x, y in m and yaw in rad, or (2,) x, y if the heading is left out, because it is unknown then.

    Raises UserError, naming ``option``, for invalid text.
    """
    return pose_of_text(text, option)[: text.count(",") + 1]


def pose_of_text(text: str, option: str) -> Array:
    """(3,) x, y in m and yaw in rad, which defaults to 0. Raises UserError, naming ``option``, for invalid text."""
    if not text or not re.fullmatch(POSE_TEXT, text):
        raise UserError(f"{option} {text!r}: give x,y[,yaw_deg] in m and degrees, such as 0.2,0,180")
    x, y, *yaw = (float(part) for part in text.split(","))
    if max(abs(x), abs(y)) > MAX_COORDINATE_M:
        raise UserError(f"{option} {text!r}: x and y must be within {MAX_COORDINATE_M:g} m of the origin")
    return np.array([x, y, np.deg2rad(yaw[0]) if yaw else 0.0])
