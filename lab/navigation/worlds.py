"""Worlds of the navigation experiment, and where starts and goals may lie."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import shapely.affinity

from common.geometry.shapes import Box, Obstacle
from common.geometry.world import World, load_world
from lab.integrity.buildings import make_building

TRIPS_PER_WORLD = 5  # before the next generated world
SEEDS_PER_RUN = 1000  # generated worlds of one run; the next seed of a run has other worlds
OTHER_BUILDINGS = 100_000_000  # added to a seed for another building
MIN_DIFFERENCE_M2 = 0.05  # between a world and itself turned by half a turn; less counts as symmetric
Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1 in m


@dataclass(frozen=True)
class StartGoalRule:
    """Where starts and goals are drawn."""

    rooms: tuple[Rectangle, ...] = ()  # inside one of these; anywhere by default
    min_length: float = 2.0  # m along the shortest path
    max_clearance: float = np.inf  # m from a start or a goal to the nearest wall

    def allows(self, world: World, places: Sequence[np.ndarray]) -> bool:
        """Whether a start and a goal may be at ``places`` (N, 2) m."""
        inside = [any(x0 <= x <= x1 and y0 <= y <= y1 for x0, y0, x1, y1 in self.rooms) for x, y in places]
        return (not self.rooms or all(inside)) and bool((world.clearance(places) <= self.max_clearance).all())


RULES = {
    # In the corridor a scan identifies the place, so a robot with a goal there would localise on the way.
    "twins": StartGoalRule(rooms=((0.0, 0.0, 5.9, 4.4), (6.1, 0.0, 12.0, 4.4))),
    # A robot can only tell within 2 cm where it is if it sees something.
    "hall": StartGoalRule(min_length=10.0, max_clearance=2.0),
}


def make_hall(seed: int) -> World:
    """An empty hall, 18 to 24 m by 13 to 16 m, with cabinets and pillars at its walls, 0.5 to 2 m apart."""
    rng = np.random.default_rng([seed, 22])
    length, width = np.round(rng.uniform([18, 13], [24, 16]), 2).tolist()
    obstacles = []
    for side, extent in enumerate((length, width, length, width)):
        along = 1.0
        while True:
            size, depth = rng.uniform([0.3, 0.4], [1.6, 0.8])
            along += rng.uniform(0.5, 2.0)
            if along + size > extent - 1.0:
                break
            obstacles.append(_at_wall(side, along + size / 2, size, depth, (length, width)))
            along += size
    boundary = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width)]
    return World(name=f"hall-{seed}", boundary=boundary, obstacles=obstacles)


def _at_wall(side: int, along: float, size: float, depth: float, hall: tuple[float, float]) -> Obstacle:
    """A box with its back to a wall of the hall, counter-clockwise from y = 0; ``along`` from its lower end."""
    across = depth / 2 if side in (0, 3) else hall[1 if side == 2 else 0] - depth / 2
    center, extent = ((along, across), (size, depth)) if side in (0, 2) else ((across, along), (depth, size))
    return Obstacle(box=Box(center=center, size=extent))


def make_look_alike(seed: int) -> World:
    """A building with identical rooms, whose corridor differs after a half turn, so that a robot can find its place."""
    worlds = (make_building(seed + attempt * OTHER_BUILDINGS, "symmetric").world for attempt in itertools.count())
    return next(world for world in worlds if _differs_when_turned(world))


def _differs_when_turned(world: World) -> bool:
    turned = shapely.affinity.rotate(world.free_space, 180, origin=tuple(world.center()))
    return bool(shapely.area(shapely.symmetric_difference(world.free_space, turned)) > MIN_DIFFERENCE_M2)


GENERATED: dict[str, Callable[[int], World]] = {
    "hall": make_hall,
    "look-alike": make_look_alike,
}


def seed_of(name: str, seed: int, trial: int) -> int:
    """Seed of the world of a trial; 0 for a world that is not generated."""
    return seed * SEEDS_PER_RUN + trial // TRIPS_PER_WORLD if name in GENERATED else 0


@functools.lru_cache(maxsize=8)
def world_of(name: str, seed: int = 0) -> World:
    """The generated world of a seed, or a world by its name or file. Raises UserError if there is none."""
    return GENERATED[name](seed) if name in GENERATED else load_world(name)
