"""Plausible ranges of physical quantities, shared by messages, worlds and scanners.

They are far above what a wheeled robot indoors or out can have, and exist so that one absurd number (1e300 m) or one
oversized scan is refused where it arrives instead of overflowing, or taking minutes, in the programs behind.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

MAX_COORDINATE_M = 10_000.0  # of a position, to either side of its frame's origin
MAX_DISTANCE_M = 30_000.0  # above the diagonal of the square of all positions
MAX_ANGLE_RAD = 10_000.0  # a heading need not be wrapped: 1500 turns
MAX_SPEED = 1_000.0  # m/s or rad/s
MAX_BEAMS = 32_768  # of one scan; the finest 2-D scanners sold measure 25 200 points a turn

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M, allow_inf_nan=False)]
Distance = Annotated[float, Field(ge=0, le=MAX_DISTANCE_M, allow_inf_nan=False)]
PositiveDistance = Annotated[float, Field(gt=0, le=MAX_DISTANCE_M, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-MAX_ANGLE_RAD, le=MAX_ANGLE_RAD, allow_inf_nan=False)]
PositiveAngle = Annotated[float, Field(gt=0, le=MAX_ANGLE_RAD, allow_inf_nan=False)]
Speed = Annotated[float, Field(ge=-MAX_SPEED, le=MAX_SPEED, allow_inf_nan=False)]
