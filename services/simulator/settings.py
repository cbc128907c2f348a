"""Settings of the simulator."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.geometry.pose_text import POSE_TEXT, pose_of_text
from common.limits import MAX_BEAMS
from common.robot.scanner import SCANNERS, Scanner
from common.robot.scanner_options import chosen_scanner
from common.runtime.robot_settings import RobotSettings


class SimulatorSettings(RobotSettings):
    """Simulator: a mobile base with a laser scanner in a world, in pybullet.

    Examples:
      python -m services.simulator                                   the corridor, in real time
      python -m services.simulator --world maze --drive differential
      python -m services.simulator --world my.yaml --start 2,1,90    x m, y m, yaw deg
      python -m services.simulator --beams 622 --pace lockstep --seed 7
      python -m services.simulator --world office --people 10        who walk about
      python -m services.simulator --scanner rplidar-a1 --mount=-0.1,0,180 --upside-down
      python -m services.simulator --radius 0.105 --max-speed 0.22 --mount=-0.032,0     a TurtleBot 3's body
      python -m services.simulator --scanner my-laser.yaml           docs/scanners.md shows such a file

    """

    service: ClassVar[str] = "simulator"

    world: Annotated[str, Field(description="shipped world, world file or ROS map.yaml")] = "corridor"
    scanner: Annotated[str, Field(description=f"one of {', '.join(SCANNERS)}, or a file")] = "tim571"
    beams: Annotated[int | None, Field(ge=2, le=MAX_BEAMS, description="instead of the scanner's own number")] = None
    noise: Annotated[float | None, Field(ge=0, le=1, description="instead of the scanner's own sigma, m")] = None
    mount: Annotated[
        str, Field(pattern=POSE_TEXT, description="x,y[,yaw_deg] of the laser in base_link; none: the scanner's own")
    ] = ""
    upside_down: Annotated[bool | None, Field(description="the laser hangs with a roll of 180 deg")] = None
    start: Annotated[str, Field(pattern=POSE_TEXT, description="x,y[,yaw_deg]; none: the world's own")] = ""
    seed: Annotated[int, Field(ge=0, description="of all noise")] = 0
    pace: Annotated[
        Literal["realtime", "fast", "lockstep"],
        Field(
            description="realtime; fast: as fast as it goes; lockstep: each scan waits for the command that answers it"
        ),
    ] = "realtime"
    lockstep_deadline: Annotated[float, Field(gt=0, description="s until a scan nobody answered is sent again")] = 5.0
    wait_for: Annotated[
        str | None,
        Field(description="services waited for before the first scan; lockstep: estimator,controller unless told"),
    ] = None
    people: Annotated[int, Field(ge=0, le=100, description="how many walk about; the map does not know them")] = 0
    people_speed: Annotated[float, Field(ge=0, le=3, description="of their walk, m/s")] = 1.0
    obstacle_stop: Annotated[
        bool, Field(description="brake before what the scan shows; off only for fault injection")
    ] = True
    turn_by_turn: Annotated[float, Field(ge=0, description="odometry alpha 1, rad²/rad")] = 1e-3
    turn_by_path: Annotated[float, Field(ge=0, description="odometry alpha 2, rad²/m")] = 5e-4
    path_by_path: Annotated[float, Field(ge=0, description="odometry alpha 3, m²/m")] = 1e-3
    path_by_turn: Annotated[float, Field(ge=0, description="odometry alpha 4, m²/rad")] = 1e-4

    def the_scanner(self) -> Scanner:
        """The scanner asked for; raises UserError for an unknown one."""
        return chosen_scanner(self.scanner, self.beams, self.noise, self.mount, upside_down=self.upside_down)

    def waited_for(self) -> set[str]:
        """Services without which time does not begin."""
        text = self.wait_for if self.wait_for is not None else "estimator,controller" * (self.pace == "lockstep")
        return {name.strip() for name in text.split(",") if name.strip()}

    def start_pose(self) -> tuple[float, float, float] | None:
        """X m, y m, yaw rad, or None."""
        if not self.start:
            return None
        x, y, yaw = map(float, pose_of_text(self.start, "--start"))
        return x, y, yaw
