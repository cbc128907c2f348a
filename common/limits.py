"""Plausible ranges of physical quantities, shared by messages, worlds and scanners.

They are far above the values of any wheeled robot. With them, an absurd number (1e300 m) or an oversized scan is
refused where it arrives, instead of causing an overflow or minutes of computation later.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

MAX_COORDINATE_M = 10_000.0  # absolute value, from the frame's origin
MAX_DISTANCE_M = 30_000.0  # more than the diagonal of the square of all valid positions
MAX_RANGE_M = 1_000.0  # measured by a scanner in a log; longer ranges are probably in mm
MAX_ANGLE_RAD = 10_000.0  # about 1500 turns, because headings need not be wrapped
MAX_SPEED = 1_000.0  # m/s or rad/s
MAX_FIELD_SIDE = 4096  # cells along one side of a published cost field
# Of the box around the walls: four times the largest building that was measured. A room of 6 m by 4 m, drawn in
# centimetres, has more.
MAX_WORLD_AREA_M2 = 200_000.0
MAX_BEAMS = 32_768  # in a scan; the 2-D scanners with the finest resolution measure 25 200 points per turn

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M, allow_inf_nan=False)]
Distance = Annotated[float, Field(ge=0, le=MAX_DISTANCE_M, allow_inf_nan=False)]
PositiveDistance = Annotated[float, Field(gt=0, le=MAX_DISTANCE_M, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-MAX_ANGLE_RAD, le=MAX_ANGLE_RAD, allow_inf_nan=False)]
PositiveAngle = Annotated[float, Field(gt=0, le=MAX_ANGLE_RAD, allow_inf_nan=False)]
Speed = Annotated[float, Field(ge=-MAX_SPEED, le=MAX_SPEED, allow_inf_nan=False)]
