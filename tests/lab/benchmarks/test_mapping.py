"""`presage bench mapping`."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from lab.benchmarks.mapping import bench_mapping, relation_errors, trajectory_errors


def random_poses(count=50):
    return np.cumsum(np.random.default_rng(0).normal(scale=0.2, size=(count, 3)), axis=0)


def test_error_of_relations():
    poses, stamps = random_poses(), np.arange(50.0)
    true = se2.between(poses[:-3], poses[3:])
    off = se2.compose(true, np.array([0.03, 0.04, 0.1]))
    moved = se2.compose(np.array([5.0, -2.0, 2.0]), poses)
    for relations, position, heading in ((true, 0.0, 0.0), (off, 0.05, 0.1)):
        table = np.column_stack([stamps[:-3], stamps[3:], relations])
        errors = relation_errors(moved, stamps, table)
        assert errors[0] == pytest.approx(position, abs=1e-9)
        assert errors[1] == pytest.approx(heading, abs=1e-9)


def test_error_of_trajectory():
    poses = random_poses()
    moved = se2.compose(np.array([5.0, -2.0, 2.0]), poses)
    for errors in trajectory_errors(moved, poses):
        assert errors == pytest.approx(0, abs=1e-9)
    moved[25, 0] += 1
    assert trajectory_errors(moved, poses)[0][25] == pytest.approx(1, abs=0.1)


def test_simulated_drive(tmp_path):
    file = tmp_path / "mapping.json"
    bench_mapping(None, None, 1, 1, 5.0, file, Console(quiet=True))
    rows = json.loads(file.read_text())["rows"]
    assert [row["odometry"] for row in rows] == [True, False]
    assert all(row["position_rms_m"] < 0.05 for row in rows)


def test_nothing_to_map(tmp_path):
    with pytest.raises(UserError, match="nothing to map"):
        bench_mapping(None, None, 0, 1, 5.0, None, Console(quiet=True))
    with pytest.raises(UserError, match="belong together"):
        bench_mapping(tmp_path / "log", None, 1, 1, 5.0, None, Console(quiet=True))
