"""Settings of the simulator."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.geometry.pose_text import POSE_PATTERN, parse_pose
from common.limits import MAX_BEAMS
from common.names import split_names
from common.robot.scanner import SCANNERS, Scanner
from common.robot.scanner_options import build_scanner
from common.runtime.robot_settings import RobotSettings


class SimulatorSettings(RobotSettings):
    """Simulator: a mobile base with a laser scanner in a world.

    Examples:
      python -m services.simulator                                   the corridor, in real time
      python -m services.simulator --world maze --drive differential
      python -m services.simulator --world my.yaml --start 2,1,90    x m, y m, yaw deg
      python -m services.simulator --beams 622 --pace lockstep --seed 7
      python -m services.simulator --world office --people 10        with ten walking people
      python -m services.simulator --scanner rplidar-a1 --mount=-0.1,0,180 --upside-down
      python -m services.simulator --radius 0.105 --max-speed 0.22 --mount=-0.032,0     the body of a TurtleBot 3
      python -m services.simulator --scanner my-laser.yaml           docs/scanners.md describes such files

    """

    service: ClassVar[str] = "simulator"

    world: Annotated[str, Field(description="a shipped world, a world file or a ROS map.yaml")] = "corridor"
    hide_world: Annotated[
        bool, Field(description="do not tell the world to other programs, as in an unknown building")
    ] = False
    scanner: Annotated[str, Field(description=f"one of {', '.join(SCANNERS)}, or a file")] = "tim571"
    beams: Annotated[
        int | None, Field(ge=2, le=MAX_BEAMS, description="number of beams; defaults to the scanner's")
    ] = None
    noise: Annotated[
        float | None, Field(ge=0, le=1, description="sigma of the range noise, m; defaults to the scanner's")
    ] = None
    mount: Annotated[
        str,
        Field(
            pattern=POSE_PATTERN,
            description="x,y[,yaw_deg] of the laser in base_link; if empty, that of the scanner model",
        ),
    ] = ""
    upside_down: Annotated[bool | None, Field(description="the laser is mounted with a roll of 180 deg")] = None
    start: Annotated[
        str,
        Field(
            pattern=POSE_PATTERN,
            description="x,y[,yaw_deg] at which the robot starts; if empty, the start of the world",
        ),
    ] = ""
    seed: Annotated[int, Field(ge=0, description="random seed of all noise and of people's motion")] = 0
    pace: Annotated[
        Literal["realtime", "fast", "lockstep"],
        Field(
            description="realtime; fast: as fast as possible; lockstep: the next scan waits for the command that "
            "answers the last one"
        ),
    ] = "realtime"
    lockstep_deadline: Annotated[
        float, Field(gt=0, description="lockstep: a scan that no command answers within this time is sent again, s")
    ] = 5.0
    wait_for: Annotated[
        str | None,
        Field(
            description="services that must be running before the first scan; defaults to estimator,controller in "
            "lockstep, otherwise to none"
        ),
    ] = None
    physics: Annotated[
        Literal["auto", "pybullet", "kinematic"],
        Field(description="auto: pybullet if it is installed; kinematic: contacts stop the robot"),
    ] = "auto"
    people: Annotated[int, Field(ge=0, le=100, description="number of walking people, who are not in the map")] = 0
    people_speed: Annotated[float, Field(ge=0, le=3, description="walking speed of the people, m/s")] = 1.0
    sweep: Annotated[
        bool, Field(description="measure one beam after another, as a rotating scanner does, not all at once")
    ] = True
    slip: Annotated[float, Field(ge=0, le=0.5, description="mean share of its motion that a wheel loses")] = 0.0
    obstacle_stop: Annotated[
        bool, Field(description="brake before obstacles in the scan; turn off only for fault injection")
    ] = True

    def build_scanner(self) -> Scanner:
        """Scanner according to the settings. Raises UserError if it is unknown."""
        return build_scanner(self.scanner, self.beams, self.noise, self.mount, upside_down=self.upside_down)

    def required_services(self) -> set[str]:
        """Names of the services that must be running before the first scan."""
        default = "estimator,controller" if self.pace == "lockstep" else ""
        text = default if self.wait_for is None else self.wait_for
        return set(split_names(text))

    def start_pose(self) -> tuple[float, float, float] | None:
        """Start x m, y m, yaw rad; None if the world's start is to be used."""
        if not self.start:
            return None
        x, y, yaw = map(float, parse_pose(self.start, "--start"))
        return x, y, yaw
