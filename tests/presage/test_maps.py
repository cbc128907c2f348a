"""ROS maps in figures and Foxglove, and `presage bench map`."""

from __future__ import annotations

import json

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from typer.testing import CliRunner

from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from common.geometry.world import World, load_world
from presage.cli.main import app
from presage.plotting.style import world_map
from presage.recordings.foxglove_shapes import grid, world_entities
from tests.common.geometry.maps import values_of

VALUES = values_of("""
    ##########
    #....??..#
    #..#.....#
    ####..####
""")
CRATE = {"circle": {"center": (3.0, 2.0), "radius": 0.3}}


@pytest.mark.parametrize("origin", [(1.0, 2.0, 0.0), (1.0, 2.0, 0.5)])
def test_a_figure_shows_each_cell_where_it_is(origin):
    world = World(name="hut", grid=OccupancyGrid.of(VALUES, 0.5, origin))
    figure = Figure(figsize=(8, 6), dpi=100)
    canvas, axes = FigureCanvasAgg(figure), figure.add_subplot()
    world_map(axes, world)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())
    row, column = np.indices(VALUES.shape).reshape(2, -1)
    places = world.grid.geometry.points_in_cells(np.column_stack([column, row]), 0.5)
    x, y = np.round(axes.transData.transform(places)).astype(int).T
    shown = pixels[len(pixels) - 1 - y, x, 0]
    assert shown.tolist() == [{FREE: 255, OCCUPIED: 0, UNKNOWN: 0xE4}[value] for value in VALUES.ravel()]


def test_map_in_foxglove():
    world = World(name="hut", grid=OccupancyGrid.of(VALUES, 0.5, (1.0, 2.0, 0.0)), obstacles=[CRATE])
    sent = grid(world, 0)
    data = np.frombuffer(sent.data, np.uint8).reshape(-1, sent.column_count, 5)[..., 4]
    rows, columns = np.indices(data.shape)
    places = np.stack([columns + 0.5, rows + 0.5], axis=-1) * sent.cell_size.x
    places += [sent.pose.position.x, sent.pose.position.y]
    inner = (np.abs(world.clearance(places.reshape(-1, 2))) > 1e-6).reshape(data.shape)
    kinds = world.grid.values_at(places.reshape(-1, 2)).reshape(data.shape)
    from_crate = np.hypot(*(places - [3.0, 2.0]).transpose(2, 0, 1))
    clear = inner & (from_crate > 0.31)
    assert set(data[clear & (kinds == FREE)]) == {0}
    assert set(data[clear & (kinds == UNKNOWN)]) == {255}
    assert set(data[(from_crate < 0.29) | (kinds == OCCUPIED)]) == {100}
    walls, crate = world_entities(world, 0)
    assert len(walls.lines[0].points) == 2 * len(world.grid.geometry.walls)
    assert crate.id == "obstacle 0"


def test_bench_of_maps(tmp_path):
    out, numbers = tmp_path / "made", tmp_path / "map.json"
    run = CliRunner().invoke(app, ["bench", "map", "--size", "300", "--out", str(out), "--json", str(numbers)])
    assert run.exit_code == 0, run.output
    assert load_world(str(out / "map.yaml")).grid.width == 300
    rows = {row["name"]: row for row in json.loads(numbers.read_text())["rows"]}
    assert rows["exact rays"]["unit"] == "ms per scan"
    assert rows["straight walls"]["value"] == len(load_world(str(out / "map.yaml")).segments)
    assert all(row["value"] > 0 for row in rows.values())
