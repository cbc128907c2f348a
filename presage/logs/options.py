"""Command-line options that describe a log."""

from __future__ import annotations

import re

import numpy as np

from common.errors import UserError
from common.geometry.pose_text import NUMBER, pose_of_text
from presage.logs.log import Reading


def angles_of(text: str) -> tuple[float, float]:
    """Angles of the first and last beam, rad, from text FIRST,LAST in degrees; raises UserError if malformed."""
    if not re.fullmatch(f"{NUMBER},{NUMBER}", text):
        raise UserError(f"--angles {text!r}: give the angles of the first and the last beam in degrees, such as -90,90")
    first, last = (float(np.deg2rad(float(part))) for part in text.split(","))
    if not 0 < last - first <= 2 * np.pi:
        raise UserError(f"--angles {text!r}: the last beam must lie up to 360 degrees to the left of the first")
    return first, last


def reading_of(
    mount: str,
    scan_topic: str,
    odom_topic: str,
    reference_topic: str,
    base_frame: str,
    angles: str,
    clock: str,
    *,
    reference: bool | None,
    range_max: float | None,
    upside_down: bool | None,
) -> Reading:
    """The options of `presage import`, `localize` and `map` as a `Reading`; raises UserError if one is malformed."""
    if clock not in ("sensor", "logger"):
        raise UserError(f"no clock {clock!r}: choose sensor or logger")
    return Reading(
        pose_of_text(mount, "--mount") if mount else None,
        scan_topic,
        odom_topic,
        base_frame,
        upside_down,
        reference,
        reference_topic,
        angles_of(angles) if angles else None,
        range_max,
        clock,  # type: ignore[arg-type]
    )
