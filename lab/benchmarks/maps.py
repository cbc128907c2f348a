"""`presage bench map`."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from common.geometry import se2
from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, Cells
from common.geometry.ros_map_writer import write_map
from common.geometry.world import World, load_world
from common.messages.requests import WorldReply
from common.robot.robot import Robot
from common.robot.scanner import SCANNERS
from presage.terminal.output import check_file, make_folder, provenance, write_json
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.geodesic_field import FreeSpaceGraph
from services.estimator.particle_filter.likelihood_field import SurfaceDistances
from services.simulator.people import People
from services.simulator.simulation import Simulation, SimulationSetup

SCANS = 100
CELL_M = 0.05
ROOM_WIDTH_M, DOOR_WIDTH_M = 6.0, 1.2


def bench_map(
    world: str, size: int, beams: int, out: Path | None, seed: int, json_file: Path | None, console: Console
) -> None:
    """Runs the benchmark, prints the table and writes it to ``json_file`` if given.

    Without ``world``, it makes a map of ``size`` by ``size`` cells in the folder ``out``, if that is given.
    """
    check_file(json_file, "--json")
    if out is not None and not world:
        make_folder(out)
    with tempfile.TemporaryDirectory() as folder:
        path = world or str(write_map(out or Path(folder), rooms(size, seed)))
        rows = measure(path, beams, seed)
    table = Table(title=f"{world or f'{size} x {size} cells'}, {beams} beams, processor time", title_justify="left")
    table.add_column("step")
    table.add_column("cost", justify="right")
    for name, value, unit in rows:
        table.add_row(name, f"{value:.3g} {unit}" if value < 1000 else f"{value:.0f} {unit}")
    console.print(table)
    write_json(json_file, {"rows": [{"name": n, "value": v, "unit": u} for n, v, u in rows], **provenance(seed)})


def measure(path: str, beams: int, seed: int) -> list[tuple[str, float, str]]:
    """Rows (name, value, unit) for the world in the file ``path``. Times are processor times, not wall times."""
    rows: list[tuple[str, float, str]] = []

    def timed(name: str, work: Callable[[], Any], times: int = 1) -> Any:
        began = time.process_time()
        result = work()
        seconds = (time.process_time() - began) / times
        rows.append((name, seconds * 1e3, "ms per scan") if times > 1 else (name, seconds, "s"))
        return result

    world: World = timed("load", lambda: load_world(path))
    rows.append(("message WORLD", len(WorldReply(world=world).encode()) / 1e3, "kB"))
    rows.append(("straight walls", float(len(timed("walls out of the cells", lambda: world.segments))), ""))
    scanner, rng = SCANNERS["tim571"].with_beams(beams), np.random.default_rng(seed)
    simulation = timed("simulator: start", lambda: Simulation(SimulationSetup(world, scanner)))
    timed("simulator: step and scan", lambda: _step_and_scan(simulation), SCANS)
    places = timed("5000 random places", lambda: world.sample_free(5000, rng, Robot().radius))
    poses = np.column_stack([places, rng.uniform(-np.pi, np.pi, len(places))])[:SCANS]
    timed("simulator: scans to learn from", lambda: simulation.sample(poses, None, None), SCANS)
    simulation.close()
    lasers, angles = se2.compose(poses, np.array(scanner.mount)), scanner.angles()
    world.ray_distances(lasers[:1], angles)  # compiles with numba, before the time is measured
    timed("exact rays", lambda: world.ray_distances(lasers, angles), SCANS)
    free = timed("controller: free space", lambda: FreeSpace.of(world))
    timed("controller: graph of free space", lambda: FreeSpaceGraph(free, Robot().radius))
    timed("particle filter: likelihood field", lambda: SurfaceDistances(world))
    start = world.start_pose(Robot().radius)[:2]
    timed("simulator: room for 10 people", lambda: People(world, 10, 1.0, rng, start, Robot().radius))
    return rows


def _step_and_scan(simulation: Simulation) -> None:
    for _ in range(SCANS):
        simulation.advance()
        simulation.observe()


def rooms(size: int, seed: int = 0) -> Cells:
    """A random grid (size, size) of square rooms with doors and boxes, surrounded by unknown cells."""
    rng = np.random.default_rng(seed)
    values = np.full((size, size), UNKNOWN, np.uint8)
    edge, room, door = size // 50, round(ROOM_WIDTH_M / CELL_M), round(DOOR_WIDTH_M / CELL_M)
    lines = range(edge, size - edge + 1, room)
    last = lines[-1]
    values[edge:last, edge:last] = FREE
    for line in lines:
        values[line - 2 : line + 2, edge - 2 : last + 2] = values[edge - 2 : last + 2, line - 2 : line + 2] = OCCUPIED
    for line in lines[1:-1]:
        for begin in lines[:-1]:
            for walls in (values, values.T):
                gap = begin + rng.integers(door, room - 2 * door)
                walls[line - 2 : line + 2, gap : gap + door] = FREE
    for _ in range(size**2 // 2000):
        (x, y), (w, h) = rng.integers(edge + 8, last - 8, 2), rng.integers(1, 10, 2)
        values[y : min(y + h, last), x : min(x + w, last)] = OCCUPIED
    return values
