"""The mobile base: drive, radius, speed and acceleration limits."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Robot(BaseModel):
    """A round base and its limits; defaults after PAL's PMB-2 (54 cm across, 1 m/s)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    drive: Literal["holonomic", "differential"] = "holonomic"
    radius: Positive = 0.27  # m
    max_speed: Positive = 1.0  # m/s, of the centre, any direction
    max_turn: Positive = 2.0  # rad/s
    acceleration: Positive = 1.0  # m/s²
    turn_acceleration: Positive = 3.0  # rad/s²
    margin: Positive = 0.05  # m, the obstacle stop keeps this gap
    command_timeout: Positive = 0.2  # s, without a newer command the robot brakes hard
    command_age: Positive = 0.5  # s, a command that answers an older scan is not obeyed
    braking: Positive = 5.0  # m/s², where it brakes hard: nobody plans with it
