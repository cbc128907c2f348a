"""The trials of every case, and a short run from the command to the table."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from lab.integrity.cases import BEAMS, CASES, make_trial
from lab.integrity.logs import LogCase
from lab.integrity.report import bench_integrity
from lab.integrity.runner import RECOVERING_FILTER, IntegrityPlan
from tests.lab.real_logs import drives as real_drive


@pytest.mark.parametrize("name", ["kidnapped-similar", "crowd", "slip", "wrong-map"])
def test_trial(name):
    case = CASES[name]
    trial = make_trial(case, 1, seconds=4.0)
    assert len(trial.observations) == len(trial.truths) == 60
    assert trial.observations[0].ranges.shape == (BEAMS,)
    assert (trial.observations[0].odom is None) == (case.odometry is None)
    assert (trial.start is None) == (not case.start_known)
    assert trial.kidnappings.tolist() == ([30] if case.kidnapping else [])
    again = make_trial(case, 1, seconds=4.0)
    assert (again.truths == trial.truths).all() or name == "wrong-map"
    assert (again.observations[-1].ranges == trial.observations[-1].ranges).all()


def test_scans_agree_with_the_map():
    trial = make_trial(CASES["unchanged"], 2, seconds=0.2)
    lasers = trial.truths + np.column_stack(
        [0.2 * np.cos(trial.truths[:, 2]), 0.2 * np.sin(trial.truths[:, 2]), 0 * trial.truths[:, 2]]
    )
    expected = trial.map_world.ray_distances(lasers, trial.scanner.angles())
    residual = np.array([observation.ranges for observation in trial.observations]) - expected
    assert residual.std() == pytest.approx(trial.scanner.sigma, rel=0.1)
    assert np.hypot(*(trial.start[0] - trial.truths[0])[:2]) < 0.25


def test_run(tmp_path, capsys):
    plan = IntegrityPlan(1, 1, ("unchanged",), ("precise",), "exact", 0.4)
    bench_integrity(plan, tmp_path, 1, Console(quiet=True))
    stored = json.loads((tmp_path / "integrity.json").read_text())["summary"]["precise"]["unchanged"]
    assert stored["correct"]["count"] == stored["correct"]["of"] == 6
    assert "| unchanged | 100 | 0 " in capsys.readouterr().out
    assert len((tmp_path / "integrity.trials.jsonl").read_text().splitlines()) == 1


def test_a_filter_with_recovery_finds_a_kidnapped_robot(tmp_path):
    filters = ("particle-filter", RECOVERING_FILTER)
    plan = IntegrityPlan(1, 2, ("kidnapped-anywhere",), filters, "exact", 4.0)
    bench_integrity(plan, tmp_path, 1, Console(quiet=True))
    scores = json.loads((tmp_path / "integrity.json").read_text())["summary"]
    kept, searched = (scores[name]["kidnapped-anywhere"]["correct"]["count"] for name in filters)
    assert kept <= 30  # the robot is carried at scan 30, and the filter keeps the pose that it was given
    assert searched > 40


@pytest.mark.parametrize(
    ("cases", "estimators", "model"),
    [(("moved-51",), ("precise",), "exact"), (("crowd",), ("x",), "exact"), (("crowd",), ("precise",), "x")],
)
def test_unknown_names(cases, estimators, model, tmp_path):
    with pytest.raises(UserError, match="choose from"):
        bench_integrity(IntegrityPlan(1, 1, cases, estimators, model), tmp_path, 1, Console(quiet=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cases": ("crowd", "crowd")}, "case 'crowd' is given twice"),
        ({"estimators": ("precise", "precise")}, "estimator 'precise' is given twice"),
        ({"logs": (LogCase("a/x.npz", None, False, False), LogCase("b/x.npz", None, False, False))}, "x-second-laser"),
        ({"worlds": 0}, "at least one world or log"),
    ],
)
def test_trials_that_would_count_twice_or_not_at_all(changes, message, tmp_path):
    plan = replace(IntegrityPlan(1, 1, ("crowd",), ("precise",), "exact"), **changes)
    with pytest.raises(UserError, match=message):
        bench_integrity(plan, tmp_path, 1, Console(quiet=True))


def test_log_with_a_learned_model(tmp_path):
    log = tmp_path / "x.npz"
    real_drive.save(log, real_drive.drive(240))
    logs = tuple(LogCase(str(log), (0.0, 0.0, 0.0), False, odometry) for odometry in (False, True))
    bench_integrity(IntegrityPlan(0, 1, (), ("precise",), logs=logs), tmp_path, 1, Console(quiet=True))
    assert len(list((tmp_path / "models").glob("*.safetensors"))) == 1
    scores = json.loads((tmp_path / "integrity.json").read_text())["summary"]["precise"]
    assert scores["x-second-odometry"]["correct"]["count"] > 100
