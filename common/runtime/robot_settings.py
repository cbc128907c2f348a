"""Settings that describe the robot, shared by controller, simulator and bridge."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from common.errors import UserError
from common.geometry.pose_text import NUMBER_PATTERN
from common.robot.robot import Robot
from common.robot.self_filter import SelfFilter
from common.runtime.config import ServiceSettings

ANGLE_BOUNDS_PATTERN = rf"{NUMBER_PATTERN}:{NUMBER_PATTERN}"
MAX_STOPPING_TIME_S = 10.0  # beyond this, the scanner sees obstacles too late to brake for them


class MotionLimitSettings(ServiceSettings):
    """Limits of the robot's motion."""

    max_speed: Annotated[
        float,
        Field(gt=0, le=10, allow_inf_nan=False, description="maximum speed of commands, m/s of the robot's centre"),
    ] = 1.0
    max_turn: Annotated[
        float,
        Field(gt=0, le=20, allow_inf_nan=False, description="maximum turn rate of commands, rad/s"),
    ] = 2.0
    acceleration: Annotated[
        float,
        Field(
            gt=0,
            le=20,
            allow_inf_nan=False,
            description="maximum acceleration, m/s²; the robot has to be able to brake with it",
        ),
    ] = 1.0
    turn_acceleration: Annotated[
        float,
        Field(gt=0, le=100, allow_inf_nan=False, description="maximum angular acceleration and braking, rad/s²"),
    ] = 3.0


class RobotSettings(MotionLimitSettings):
    """A round base and its limits. Controller, simulator and bridge have to get the same values."""

    drive: Annotated[
        Literal["holonomic", "differential"],
        Field(description="drive of the robot: holonomic moves in any direction, differential along its heading"),
    ] = "holonomic"
    radius: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            allow_inf_nan=False,
            description="radius of the robot in m, from base_link to its farthest corner; kept free of walls",
        ),
    ] = 0.27
    dead_band: Annotated[
        float, Field(ge=0, le=1, allow_inf_nan=False, description="speed below which the base does not move, m/s")
    ] = 0.0
    turn_dead_band: Annotated[
        float, Field(ge=0, le=1, allow_inf_nan=False, description="turn rate below which the base does not turn, rad/s")
    ] = 0.0
    latency: Annotated[
        float, Field(ge=0, le=0.3, allow_inf_nan=False, description="time from a command to its effect, s")
    ] = 0.0

    def build_robot(self) -> Robot:
        """Builds a robot with these limits; raises UserError if it would take too long to stop."""
        for speed_name, acceleration_name, unit in (
            ("max_speed", "acceleration", "m/s"),
            ("max_turn", "turn_acceleration", "rad/s"),
        ):
            speed, acceleration = getattr(self, speed_name), getattr(self, acceleration_name)
            if speed / acceleration > MAX_STOPPING_TIME_S:
                names = (speed_name, acceleration_name)
                speed_option, acceleration_option = (f"--{name.replace('_', '-')}" for name in names)
                raise UserError(
                    f"{speed_option} {speed:g} {unit} with {acceleration_option} {acceleration:g} {unit}²: the robot "
                    f"would take {speed / acceleration:.0f} s to stop, more than {MAX_STOPPING_TIME_S:g} s; "
                    f"lower {speed_option} or raise {acceleration_option}"
                )
        for band_name, speed_name in (("dead_band", "max_speed"), ("turn_dead_band", "max_turn")):
            band, speed = getattr(self, band_name), getattr(self, speed_name)
            if band >= speed:
                raise UserError(
                    f"--{band_name.replace('_', '-')} {band:g} with --{speed_name.replace('_', '-')} {speed:g}: the "
                    "robot would never move; raise the latter, or lower the former"
                )
        return Robot(
            drive=self.drive,
            radius=self.radius,
            max_speed=self.max_speed,
            max_turn=self.max_turn,
            acceleration=self.acceleration,
            turn_acceleration=self.turn_acceleration,
            dead_band=self.dead_band,
            turn_dead_band=self.turn_dead_band,
            latency=self.latency,
        )


class SelfFilterSettings(RobotSettings):
    """Settings of a robot whose scanner sees parts of the robot. Controller and bridge have to get the same values."""

    ignore_angles: Annotated[
        str,
        Field(
            pattern=rf"^$|^{ANGLE_BOUNDS_PATTERN}(,{ANGLE_BOUNDS_PATTERN})*$",
            description="LOWER:UPPER,... in degrees in the scan's frame, seen from above: sectors in which the scanner "
            "sees the robot itself (as laser_filters' angular bounds). Beams in them are ignored, also when braking",
        ),
    ] = ""
    blind_radius: Annotated[
        float,
        Field(
            ge=0,
            le=5,
            allow_inf_nan=False,
            description="distance in m around the scanner in which it sees the robot itself (as laser_filters' lower "
            "threshold). Shorter beams are ignored, also when braking; 0 ignores none",
        ),
    ] = 0.0

    def build_self_filter(self) -> SelfFilter:
        """Filter of the beams that hit the robot; raises UserError for invalid angles."""
        sectors = []
        for text in filter(None, self.ignore_angles.split(",")):
            low, high = (float(each) for each in text.split(":"))
            if not -360 <= low < high <= 360:
                raise UserError(
                    f"--ignore-angles {text}: give the lower bound first, both in degrees from -360 to 360, such as "
                    "150:210 for the 60 degrees behind the robot"
                )
            sectors.append((float(np.deg2rad(low)), float(np.deg2rad(high))))
        if sum(high - low for low, high in sectors) >= 2 * np.pi:
            raise UserError(
                f"--ignore-angles {self.ignore_angles}: these sectors cover the full circle and leave no beams"
            )
        return SelfFilter(tuple(sectors), self.blind_radius)
