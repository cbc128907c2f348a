"""Refuses goals at which the robot would touch a wall of the map."""

from __future__ import annotations

from typing import TYPE_CHECKING

from common.geometry.floors import place_text

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from common.geometry.world import World


def wall_refusal(world: World, goal: Array, radius: float) -> str | None:
    """The reason why a robot of ``radius`` m cannot stand at a goal (2,) m, or None if it can."""
    if world.has_room(goal, radius):
        return None
    return f"{place_text(world.floors, goal)} in {world.name} {near_wall(float(world.clearance(goal)[0]))}"


def near_wall(clearance: float) -> str:
    """What is wrong with a goal ``clearance`` m from the nearest wall."""
    return "is inside something, or off the map" if clearance < 0 else f"is {clearance:.2f} m from a wall"
