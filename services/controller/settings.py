"""Settings of the controller."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.errors import UserError
from common.runtime.robot_settings import SelfFilterSettings


class ControllerSettings(SelfFilterSettings):
    """Controller: turns each belief, and the current goal, into a velocity command.

    Examples:
      python -m services.controller
      python -m services.controller --max-speed 0.5      drives more slowly
      python -m services.controller --drive differential --radius 0.105 --max-speed 0.22    a TurtleBot 3
      python -m services.controller --preset paper       straight to the goal, as in the paper
      python -m services.controller --preset paper --world ''    without a map
      python -m services.controller --world ''           in the map that the mapper builds
      presage goal 15 1.5                                sends a goal to the controller

    """

    service: ClassVar[str] = "controller"

    world: Annotated[
        str,
        Field(
            description="the map: a shipped world, a world file or a ROS map.yaml; if empty, the growing map of the "
            "mapper (preset geodesic) or none (preset paper)"
        ),
    ] = "corridor"
    preset: Annotated[
        Literal["geodesic", "paper"],
        Field(description="geodesic: around walls and obstacles in the scan; paper: straight to the goal (equation 4)"),
    ] = "geodesic"
    heading: Annotated[
        Literal["travel", "keep"],
        Field(description="a holonomic robot turns to face its direction of travel, or keeps its heading"),
    ] = "travel"
    epistemic: Annotated[bool, Field(description="motions are also judged by the information that they gain")] = True
    gamma: Annotated[float, Field(gt=0, lt=1, description="preset paper: action step size per scan (equation 4)")] = 0.3
    belief_timeout: Annotated[
        float, Field(gt=0, le=60, description="the robot stops after this time without a belief, s")
    ] = 0.5

    def check(self) -> None:
        """Raises UserError if settings contradict each other."""
        self.build_robot()
        self.build_self_filter()
        if self.heading == "keep" and self.drive == "differential":
            raise UserError(
                "a differential robot cannot keep its heading: give --drive holonomic, or leave out --heading keep"
            )
        if self.preset == "paper" and self.drive != "holonomic":
            raise UserError(
                "preset paper moves without turning, which only a holonomic robot can: give --drive holonomic, or use "
                "--preset geodesic"
            )
