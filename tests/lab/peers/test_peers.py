"""A small run over a folder of scans like those on which other programs were measured."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry.ros_map_writer import write_grid
from common.geometry.world import load_world, save_world
from lab.accuracy.scenes import Scene
from lab.integrity.maps import noisy_grid
from lab.peers import experiment
from lab.peers.scans import map_file, read_trial_scans

BEAMS = 120


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A world, its map, two places and two short drives."""
    out = tmp_path_factory.mktemp("peers")
    scene = Scene.of(load_world("maze"), BEAMS, 5000)
    scene.scanner = scene.scanner.model_copy(update={"mount": (0.0, 0.0, 0.0)})
    (out / "world.yaml").write_text(save_world(scene.world), encoding="utf-8")
    write_grid(out, "map", noisy_grid(scene).grid)
    drives = np.array([scene.path(56 / scene.scanner.rate) for _ in range(2)])
    for name, truth in (("held", np.repeat(scene.poses(2)[:, None], 12, axis=1)), ("track", drives)):
        clean = scene.clean(truth.reshape(-1, 3))
        ranges = np.array([scene.observe(each, 0.0).ranges for each in clean]).reshape(*truth.shape[:2], BEAMS)
        np.savez(
            out / f"{name}.npz",
            ranges_mm=np.where(np.isfinite(ranges), 1e3 * ranges, 0).astype(np.uint16),
            truth=truth,
            odom=truth,
            angles=scene.scanner.angles(),
            range_max=scene.scanner.range_max,
            sigma=scene.scanner.sigma,
        )
    return out


def test_run(folder, tmp_path):
    names = ("presage, polygons", "particle-filter, 5 cm map")
    result = experiment.run(folder, names, 1, 5000, tmp_path, 1, Console(quiet=True))
    for task in experiment.TASKS.values():
        row = result.summary[f"{task}, presage, polygons"]
        assert (row["converged"], row["trials"], row["wrong_tracking"]) == (1, 1, 0)
        assert row["error_median_m"] < 0.02
    others = {
        "rows": [
            {"task": "odometry", "name": "Other", "knows": "–", "converged": "1/1", "error_cm": "1", "cpu_ms": "2"}
        ]
    }
    (tmp_path / "peers-others.json").write_text(json.dumps(others))
    table = experiment.table_with_others(tmp_path)
    assert "| presage, polygons | 1/1" in table
    assert "| Other | 1/1 | 1 | 2 |" in table


def test_drives_for_learning(folder):
    scans = read_trial_scans(folder / "track.npz")
    drive = scans.drive(range(2))
    assert drive.ranges.shape == (112, BEAMS)
    assert (np.diff(drive.stamps) > 0).all()
    assert drive.poses[56] == pytest.approx(scans.truth[1, 0])


def test_missing_files(tmp_path):
    with pytest.raises(UserError, match="there is no such file"):
        map_file(tmp_path)
