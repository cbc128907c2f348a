"""Maps given to the estimator that differ from the building."""

from __future__ import annotations

import numpy as np

from common.geometry.shapes import Circle, Obstacle
from common.geometry.world import World
from lab.accuracy.scenes import Scene
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.mapper.slam.drive import Laser
from services.mapper.slam.grid import grid_of_scans

CELL_M, SCANS = 0.05, 300


def scaled_map(world: World, factor: float) -> World:
    """The world with all coordinates multiplied by ``factor``."""
    obstacles = [
        Obstacle(polygon=[(x, y) for x, y in (factor * ring).tolist()])
        if (ring := obstacle.ring()) is not None
        else _scaled_circle(obstacle.circle, factor)
        for obstacle in world.obstacles
    ]
    boundary = [(x * factor, y * factor) for x, y in world.boundary]
    return World(name=f"{world.name}-scaled", boundary=boundary, obstacles=obstacles)


def _scaled_circle(circle: Circle | None, factor: float) -> Obstacle:
    assert circle is not None  # noqa: S101 - for the type checker
    x, y = circle.center
    return Obstacle(circle=Circle(center=(x * factor, y * factor), radius=circle.radius * factor))


def noisy_grid(scene: Scene) -> World:
    """An occupancy grid of 5 cm cells, built from noisy scans at known random poses."""
    poses, scanner = scene.poses(SCANS), scene.scanner
    ranges = np.array([scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)])
    stamps, mount = np.arange(len(poses)) / scanner.rate, np.array(scanner.mount)
    drive = ReferenceDrive(stamps, poses, ranges, scanner.angles(), mount, scanner.range_max)
    return grid_of(f"{scene.world.name}-grid", drive)


def grid_of(name: str, drive: ReferenceDrive) -> World:
    """The world that an occupancy grid of 5 cm cells shows, built from scans with known poses."""
    laser = Laser(drive.angles, drive.mount, drive.range_max)
    grid = grid_of_scans(drive.poses, drive.ranges, laser, CELL_M)
    return World.model_validate({"name": name, "grid": grid})
