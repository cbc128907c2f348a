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
    max_speed: Positive = 1.0  # m/s, in any direction
    max_turn: Positive = 2.0  # rad/s
    acceleration: Positive = 1.0  # m/s²
    turn_acceleration: Positive = 3.0  # rad/s²
    dead_band: NotNegative = 0.0  # m/s, slower commands do not move the base
    turn_dead_band: NotNegative = 0.0  # rad/s, slower commands do not turn it
    latency: NotNegative = 0.0  # s, from a command to its effect
    margin: Positive = 0.02  # m, gap that the obstacle stop keeps
    command_timeout: Positive = 0.2  # s without a new command until the robot brakes hard
    command_age: Positive = 0.5  # s, commands for older scans are ignored
    braking: Positive = 5.0  # m/s², of hard braking
