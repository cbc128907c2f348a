"""Settings of the controller."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.errors import UserError
from common.runtime.robot_settings import SeenRobotSettings


class ControllerSettings(SeenRobotSettings):
    """Action controller: from each belief, and the goal preferred, a velocity command.

    Examples:
      python -m services.controller
      python -m services.controller --max-speed 0.5      more careful
      python -m services.controller --drive differential --radius 0.105 --max-speed 0.22    a TurtleBot 3
      python -m services.controller --preset paper       straight to the goal, as the paper has it
      python -m services.controller --preset paper --world ''    with no map at all
      presage goal 15 1.5                                gives it something to do

    """

    service: ClassVar[str] = "controller"

    world: Annotated[
        str, Field(description="the map: shipped world, world file or ROS map.yaml; empty, of preset paper alone: none")
    ] = "corridor"
    preset: Annotated[
        Literal["geodesic", "paper"],
        Field(description="geodesic: round walls and what the scan shows; paper: equation 4, straight to the goal"),
    ] = "geodesic"
    heading: Annotated[
        Literal["travel", "keep"], Field(description="a holonomic robot turns into its way, or keeps its heading")
    ] = "travel"
    epistemic: Annotated[
        bool, Field(description="with a goal and several possible places, drive to where they can be told apart")
    ] = True
    resume: Annotated[bool, Field(description="started again, go on to the goal it was on the way to")] = True
    gamma: Annotated[float, Field(gt=0, lt=1, description="paper: action step size a scan (eq. 4)")] = 0.3
    reach: Annotated[float, Field(gt=0, le=100, description="paper: m by which the goal attracts at most")] = 2.0
    belief_timeout: Annotated[float, Field(gt=0, le=60, description="s without a belief until the robot stands")] = 0.5

    def check(self) -> None:
        """Raises UserError where settings do not go together."""
        self.build_robot()
        self.build_self_filter()
        if self.preset == "geodesic" and not self.world:
            raise UserError("preset geodesic needs a map: give --world, or --preset paper")
        if self.preset == "paper" and self.drive != "holonomic":
            raise UserError("preset paper moves without turning: give --drive holonomic, or --preset geodesic")
