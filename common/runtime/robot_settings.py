"""Settings that describe the robot, shared by controller, simulator and bridge."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from common.errors import UserError
from common.geometry.pose_text import NUMBER
from common.robot.base import Robot
from common.robot.self_filter import SelfFilter
from common.runtime.config import ServiceSettings

BOUNDS = rf"{NUMBER}:{NUMBER}"
LONGEST_BRAKE = 10.0  # s; who stops more slowly than that cannot be driven by looking ahead


class RobotSettings(ServiceSettings):
    """A round base and its limits. Whoever drives and whoever brakes has to be told the same."""

    drive: Annotated[
        Literal["holonomic", "differential"],
        Field(description="of the robot: holonomic moves any way, differential turns to where it goes"),
    ] = "holonomic"
    radius: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            allow_inf_nan=False,
            description="of the robot, m: from base_link to its farthest corner; what it keeps from walls",
        ),
    ] = 0.27
    max_speed: Annotated[
        float,
        Field(gt=0, le=10, allow_inf_nan=False, description="m/s of its centre: no command is faster"),
    ] = 1.0
    max_turn: Annotated[
        float,
        Field(gt=0, le=20, allow_inf_nan=False, description="rad/s: no command turns faster"),
    ] = 2.0
    acceleration: Annotated[
        float,
        Field(gt=0, le=20, allow_inf_nan=False, description="m/s² with which it gains speed, and surely brakes"),
    ] = 1.0
    turn_acceleration: Annotated[
        float,
        Field(gt=0, le=100, allow_inf_nan=False, description="rad/s², the same of turning"),
    ] = 3.0

    def build_robot(self) -> Robot:
        """Its limits; raises UserError where they do not go together."""
        for speed, acceleration, unit in (
            ("max_speed", "acceleration", "m/s"),
            ("max_turn", "turn_acceleration", "rad/s"),
        ):
            most, rate = getattr(self, speed), getattr(self, acceleration)
            if most / rate > LONGEST_BRAKE:
                first, second = (f"--{name.replace('_', '-')}" for name in (speed, acceleration))
                raise UserError(
                    f"{first} {most:g} {unit} with {second} {rate:g} {unit}²: the robot would take {most / rate:.0f} s "
                    f"to stop, {LONGEST_BRAKE:g} s are the most; a lower {first}, or a higher {second}"
                )
        return Robot(
            drive=self.drive, radius=self.radius, max_speed=self.max_speed, max_turn=self.max_turn,
            acceleration=self.acceleration, turn_acceleration=self.turn_acceleration,
        )  # fmt: skip


class SeenRobotSettings(RobotSettings):
    """Of a robot whose scanner sees itself. Whoever takes scans and brakes has to be told the same."""

    ignore_angles: Annotated[
        str,
        Field(
            pattern=rf"^$|^{BOUNDS}(,{BOUNDS})*$",
            description="LOWER:UPPER,... deg in the scan's own frame, seen from above, where the robot itself is seen "
            "(laser_filters' angular bounds): such beams say nothing, nothing there is braked for",
        ),
    ] = ""
    blind_radius: Annotated[
        float,
        Field(
            ge=0, le=5, allow_inf_nan=False,
            description="m about the scanner within which it sees the robot itself (laser_filters' lower threshold): "
            "shorter beams say nothing, nothing nearer is braked for; 0: none",
        ),
    ] = 0.0  # fmt: skip

    def build_self_filter(self) -> SelfFilter:
        """What is cut out of each scan; raises UserError where bounds are none."""
        sectors = []
        for text in filter(None, self.ignore_angles.split(",")):
            low, high = (float(each) for each in text.split(":"))
            if not -360 <= low < high <= 360:
                raise UserError(
                    f"--ignore-angles {text}: the lower bound goes first, both in degrees from -360 to 360, such as "
                    "150:210 for 30 degrees to either side of behind"
                )
            sectors.append((float(np.deg2rad(low)), float(np.deg2rad(high))))
        if sum(high - low for low, high in sectors) >= 2 * np.pi:
            raise UserError(
                f"--ignore-angles {self.ignore_angles}: that is all round, and nothing would be seen at all"
            )
        return SelfFilter(tuple(sectors), self.blind_radius)
