"""What a service can be told of the robot: one set of settings for all that move it or hold it back."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from common.config import ServiceSettings
from common.errors import UserError
from common.robot import Robot

LONGEST_BRAKE = 10.0  # s; who stops more slowly than that cannot be driven by looking ahead


class RobotSettings(ServiceSettings):
    """A round base and its limits. Whoever drives and whoever brakes has to be told the same."""

    drive: Annotated[
        Literal["holonomic", "differential"],
        Field(description="of the robot: holonomic moves any way, differential turns to where it goes"),
    ] = "holonomic"
    radius: Annotated[
        float,
        Field(gt=0, le=5, allow_inf_nan=False, description="of the robot, m: from base_link to its farthest corner"),
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

    def the_robot(self) -> Robot:
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
