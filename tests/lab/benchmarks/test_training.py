"""The benchmark of the shipped models' training."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from common.errors import UserError
from lab.benchmarks import training
from lab.benchmarks.training import bench_training, table
from presage.learning import train_precise


def test_trains_a_shipped_model_with_another_seed(tmp_path: Path, presage, monkeypatch):
    def in_this_process(command, **_):
        assert command[:3] == [sys.executable, "-m", "presage"]
        status, output = presage(*command[3:])
        return subprocess.CompletedProcess(command, status, output, output)

    monkeypatch.setattr(training.subprocess, "run", in_this_process)
    for samples in ("CALIBRATION_SAMPLES", "TEST_SAMPLES"):
        monkeypatch.setattr(train_precise, samples, 40)
    result = tmp_path / "training.json"
    bench_training("maze-precise", 1, 40, tmp_path / "out", result, Console(quiet=True))
    (row,) = json.loads(result.read_text())["rows"]
    (trained,) = row["trained"]
    card = json.loads((tmp_path / "out" / "seed1" / "maze-precise.json").read_text())
    assert (card["seed"], card["samples"], card["world"]["name"]) == (1, 40, "maze")
    assert trained["test_range_error_median_m"] == card["test_range_error_median_m"]
    # 40 scans show less than the 5000 of the shipped model
    assert trained["test_range_error_median_m"] > row["shipped"]["test_range_error_median_m"]


def test_unknown_model(tmp_path: Path):
    with pytest.raises(UserError, match="no such model; choose from corridor-paper-622"):
        bench_training("attic-precise", 1, None, tmp_path, None, Console(quiet=True))


def test_table_shows_the_least_and_largest_error():
    def errors(median: float) -> dict[str, float]:
        return {"test_l1_median": median, "test_l1_mean": 0.3}

    row = {"model": "corridor-paper-622", "shipped": errors(0.05), "trained": [errors(0.06), errors(0.04)]}
    cells = [cell.strip() for cell in table([row]).splitlines()[2].split("|")[1:-1]]
    assert cells == ["corridor-paper-622", "50; 40 to 60", "300; 300 to 300", "–", "–"]
