"""Interface of a physics engine, and the choice of one."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal, Protocol

from common.errors import UserError
from common.packages import install_command

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import Obstacle

SUBSTEP_S = 1 / 240  # time step of the physics: pybullet's default

Engine = Literal["pybullet", "kinematic"]


class Physics(Protocol):
    """The world's walls, furniture and people, and the robot. Poses are of base_link in map."""

    def close(self) -> None:
        """Releases what the engine holds."""

    def add(self, name: str, obstacle: Obstacle) -> None:
        """Adds a piece of furniture."""

    def remove(self, name: str) -> None:
        """Removes a piece of furniture."""

    def add_people(self, places: Array, radius: float) -> None:
        """Adds people at ``places`` (K, 2) m as round bodies, which collide with the robot only."""

    def move_people(self, places: Array) -> None:
        """Puts the people at ``places`` (K, 2) m."""

    def place(self, pose: Array) -> None:
        """Puts the robot at a pose (3,), with zero velocity."""

    def pose(self) -> Array:
        """The robot's pose (3,)."""
        ...

    def twist(self) -> Array:
        """The robot's velocity (3,) in base_link."""
        ...

    def drive(self, twist: Array) -> bool:
        """Simulates a substep with the motors set to ``twist`` (3,) in base_link; returns whether there was contact."""
        ...

    def ranges(self, lasers: Array, angles: Array, reach: float, *, people: bool = True) -> Array:
        """Exact ranges (N, B) m from laser poses (N, 3) in map along ``angles`` (B,); +inf beyond ``reach`` m.

        With ``people=False`` rays pass through people.
        """
        ...


def choose_engine(wanted: Literal["auto", "pybullet", "kinematic"]) -> Engine:
    """The engine to use; auto is pybullet if it is installed, else kinematic. Raises UserError if it is missing."""
    if wanted == "kinematic":
        return wanted
    installed = find_spec("pybullet") is not None
    if wanted == "pybullet" and not installed:
        command = install_command("pybullet")
        raise UserError(f"physics: pybullet is not installed; install it with: {command}; or set physics to kinematic")
    return "pybullet" if installed else "kinematic"
