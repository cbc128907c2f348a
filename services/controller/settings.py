"""What the controller can be told."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.config import ServiceSettings


class ControllerSettings(ServiceSettings):
    """Action controller: from each belief, and the goal preferred, a velocity command.

    Examples:
      python -m services.controller
      python -m services.controller --max-speed 0.5      more careful
      python -m services.controller --world ''           do not check goals against a world
      presage goal 15 1.5                                gives it something to do

    """

    service: ClassVar[str] = "controller"

    world: Annotated[str, Field(description="world that goals are checked against; empty: none")] = "corridor"
    preset: Annotated[Literal["paper"], Field(description="paper: equation 4, straight to the goal")] = "paper"
    drive: Annotated[Literal["holonomic"], Field(description="the paper's robot moves without turning")] = "holonomic"
    max_speed: Annotated[float, Field(gt=0, le=10, description="m/s")] = 1.0
    acceleration: Annotated[float, Field(gt=0, le=20, description="m/s²")] = 1.0
    gamma: Annotated[float, Field(gt=0, lt=1, description="action step size a scan (eq. 4)")] = 0.3
    reach: Annotated[float, Field(gt=0, le=100, description="m by which the goal attracts the belief at most")] = 2.0
    belief_timeout: Annotated[float, Field(gt=0, le=60, description="s without a belief until the robot stands")] = 0.5
