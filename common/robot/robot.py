"""The mobile base: drive, radius, speed and acceleration limits."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Robot(BaseModel):
    """A round mobile base and its limits; the defaults are those of PAL's PMB-2 (54 cm in diameter, 1 m/s)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    drive: Literal["holonomic", "differential"] = "holonomic"
    radius: Positive = 0.27  # m
    max_speed: Positive = 1.0  # m/s, of the centre, in any direction
    max_turn: Positive = 2.0  # rad/s
    acceleration: Positive = 1.0  # m/s²
    turn_acceleration: Positive = 3.0  # rad/s²
    dead_band: NotNegative = 0.0  # m/s, the base does not move at a lower speed
    turn_dead_band: NotNegative = 0.0  # rad/s, nor turns at a lower rate
    latency: NotNegative = 0.0  # s, from a command to its effect
    margin: Positive = 0.05  # m, gap to obstacles that the obstacle stop keeps
    command_timeout: Positive = 0.2  # s, the robot brakes hard if it gets no new command for this time
    command_age: Positive = 0.5  # s, commands that respond to older scans are ignored
    braking: Positive = 5.0  # m/s², deceleration of hard braking; not used for planning
