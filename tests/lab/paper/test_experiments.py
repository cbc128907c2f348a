"""Trials, results and the results page of the experiments, and small runs of E1 and E2."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry.world import FOLDER
from lab.accuracy.scenes import Scene
from lab.experiments import results, trials
from lab.experiments.estimators import PAPER_DESCENT, ExperimentWorld, parse_estimators
from lab.experiments.trials import TrialStore, run_trials
from lab.pages import tables_page as page
from lab.paper import alpha_sweep as step_size
from lab.paper import e1_localisation as localisation
from lab.paper import e2_crossing as crossing
from lab.paper.suite import FinishedExperiments
from tests.conftest import ROOT
from tests.lab.paper.counting import Count, count

QUIET = Console(quiet=True)


def jobs(folder, **more):
    return [Count(index, str(folder), **more) for index in range(6)]


@pytest.mark.parametrize("workers", [1, 2])
def test_order_of_results(tmp_path, workers):
    rows = run_trials("count", count, jobs(tmp_path), tmp_path, workers, QUIET)
    assert [row["square"] for row in rows] == [0, 1, 4, 9, 16, 25]
    assert sorted((tmp_path / "ran").read_text().split()) == list("012345")
    assert [path.name for path in tmp_path.iterdir()] == ["ran"]


def test_progress_without_a_terminal(tmp_path, monkeypatch):
    monkeypatch.setattr(trials, "LINE_INTERVAL_S", 0.0)
    console = Console(file=io.StringIO(), width=100)
    run_trials("count", count, jobs(tmp_path), tmp_path, 1, console)
    lines = [line for line in console.file.getvalue().splitlines() if line.startswith("count:")]
    assert lines == ["count: 6 trials", *(f"count: {done} of 6 trials done" for done in range(1, 7))]


def test_interrupted_run(tmp_path):
    with pytest.raises(ValueError, match="as asked"):
        run_trials("count", count, jobs(tmp_path, fails_at=4), tmp_path, 1, QUIET)
    ran = set((tmp_path / "ran").read_text().split())
    assert "4" not in ran
    kept = TrialStore(tmp_path / ".count.unfinished.jsonl", jobs(tmp_path, fails_at=4)).read()
    (tmp_path / "ran").unlink()
    (tmp_path / "mended").touch()
    rows = run_trials("count", count, jobs(tmp_path, fails_at=4), tmp_path, 1, QUIET)
    assert [row["square"] for row in rows] == [0, 1, 4, 9, 16, 25]
    assert len(kept) >= 1
    again = {int(index) for index in (tmp_path / "ran").read_text().split()}
    assert again == set(range(6)) - set(kept)


def test_results_of_other_jobs(tmp_path):
    path = tmp_path / "store"
    TrialStore(path, jobs(tmp_path)).add(0, {"square": 99})
    assert TrialStore(path, jobs(tmp_path, fails_at=3)).read() == {}
    assert not path.exists()


def test_results_of_a_file_that_was_replaced(tmp_path):
    named = tmp_path / "hall.yaml"
    named.write_text((FOLDER / "maze.yaml").read_text())
    TrialStore(tmp_path / "store", jobs(tmp_path, world=str(named))).add(0, {"square": 99})
    assert TrialStore(tmp_path / "store", jobs(tmp_path, world=str(named))).read() == {0: {"square": 99}}
    named.write_text((FOLDER / "office.yaml").read_text())
    assert TrialStore(tmp_path / "store", jobs(tmp_path, world=str(named))).read() == {}


def test_incomplete_last_line(tmp_path):
    path = tmp_path / "store"
    store = TrialStore(path, jobs(tmp_path))
    store.add(0, {"square": 0})
    store.add(1, {"square": 1})
    path.write_text(path.read_text()[:-5])
    assert store.read() == {0: {"square": 0}}
    store.add(1, {"square": 1})
    assert store.read() == {0: {"square": 0}, 1: {"square": 1}}


def small(index, **more):
    return localisation.LocalisationJob(index, 5, 4, ("paper", "precise"), **more)


def test_reproducible_trials():
    alone = localisation.trial(small(1))
    localisation.trial(small(0))
    assert localisation.trial(small(1)) == alone
    assert localisation.trial(small(2))["pose"] != alone["pose"]


def test_variation_of_the_page():
    """The code in docs/experiments.md, with another world and an estimator of one's own."""
    text = (ROOT / "docs/experiments.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    names = {}
    exec(block, names)
    assert names["errors"].keys() == {"precise", "mine"}
    assert all(0 < error < 0.02 for error in names["errors"].values())


def test_paper_descent_is_slow():
    for index in range(3):
        errors = localisation.trial(replace(small(index), iterations=30, descent=PAPER_DESCENT))["error_m"]
        assert errors["precise"][0] < 0.01
        assert errors["paper"][0] > 10 * errors["precise"][0]
        assert errors["paper"][-1] < errors["paper"][0]


def test_e1_summary():
    def row(errors, claim, *, front):
        limit = np.diag([3e-2, 4e-2, 0.1]) ** 2  # 5 cm
        return {"error_m": {"x": errors}, "claim": {"x": claim}, "in_front": front, "bound": limit.tolist()}

    rows = [row([3, 0.1, 0.1], "tracking", front=True), row([0.1, 0.3, 0.1], "tracking", front=True),
            row([4, 4, 4], "tracking", front=False), row([4, 4, 0.3], "localising", front=False)]  # fmt: skip
    found = localisation.summarise(rows, "x")
    assert found["found_within_0.2_m"] == 2
    assert found["found_within_0.5_m"] == 3
    assert found["claimed_tracking"] == 3
    assert found["claimed_tracking_but_wrong"] == 1
    assert found["in_front_within_0.5_m"] == found["places_in_front"] == 2
    two = localisation.summarise(rows[:2], "x")
    assert two["iterations_to_0.2_m_median"] == 2.5  # after 2, and after 3
    assert two["final_rms_over_bound"] == pytest.approx(0.1 / (0.05 / np.sqrt(3)))


def test_crossing_path():
    scene = ExperimentWorld().scene(3, 4)
    path = crossing.path_of(scene, 1.0, 0.05)
    assert (scene.world.clearance(path[:, :2]) > 0.37).all()
    assert np.allclose(np.diff(path, axis=0), [0.05, 0, 0])
    assert path[-1, 0] - path[0, 0] > 16


def test_world_without_a_free_line():
    scene = Scene.of(ExperimentWorld("maze").scene(0).world, 622, 0)
    with pytest.raises(UserError, match="no free straight line"):
        crossing.path_of(scene, 0.0, 0.05)


def test_crossing_with_precise():
    found = crossing.trial(crossing.CrossingJob(0, 2, 0.2, ("precise", "precise, odometry")))
    assert max(found["error_m"]["precise, odometry"]) < 0.02
    assert np.median(found["error_m"]["precise"]) < 0.005


def test_best_step_size():
    rows = {
        "a": {"steps_a_scan": 1, "alpha_m2": 1.0, "found_within_0.2_m": 3, "final_error_median_m": 0.1},
        "b": {"steps_a_scan": 1, "alpha_m2": 2.0, "found_within_0.2_m": 4, "final_error_median_m": 0.2},
        "c": {"steps_a_scan": 1, "alpha_m2": 3.0, "found_within_0.2_m": 4, "final_error_median_m": 0.1},
        "d": {"steps_a_scan": 10, "alpha_m2": 4.0, "found_within_0.2_m": 9, "final_error_median_m": 0.1},
    }
    assert step_size.best(rows, 1) == 3.0


def test_estimator_names():
    assert parse_estimators("paper,particle-filter heading known") == ("paper", "particle-filter, heading known")
    assert parse_estimators("precise, odometry,paper") == ("precise, odometry", "paper")
    assert parse_estimators("paper, 10 steps a scan , precise") == ("paper, 10 steps a scan", "precise")
    with pytest.raises(UserError, match="no estimator 'kalman'"):
        parse_estimators("paper,kalman")


def test_page_from_results(tmp_path):
    result = results.Result("e2", "t", 0, {}, {"precise": crossing.summarise(
        [{"error_m": {"precise": [0.001, 0.003]}, "lost": {"precise": False}, "bound_m": {"one scan": [0.001, 0.001]}}],
        "precise")}, notes=["a remark"])  # fmt: skip
    result.write(tmp_path, None)
    text = "before\n<!-- table e2 -->\nold\n<!-- end -->\nafter\n"
    fill_tables = page.fill_tables(text, tmp_path)
    assert "| 2.24 | 2.2 |" in fill_tables
    assert "a remark" not in fill_tables.lower()
    assert "old" not in fill_tables
    assert page.fill_tables(fill_tables, tmp_path) == fill_tables
    with pytest.raises(UserError, match="presage experiment e1"):
        page.fill_tables(text.replace("e2", "e1"), tmp_path)


def test_files_of_e1(presage, monkeypatch, tmp_path):
    monkeypatch.setenv("PRESAGE_WORKERS", "1")
    args = ("e1", "--trials", "2", "--iterations", "3", "--estimators", "precise")
    status, output = presage("experiment", "--out", str(tmp_path), *args)
    assert status == 0, output
    assert {path.name for path in tmp_path.iterdir()} == {"e1.json", "e1.csv", "e1.trials.jsonl", "e1.pdf", "e1.png"}
    found = json.loads((tmp_path / "e1.json").read_text())
    assert found["command"].endswith(" e1 --trials 2 --iterations 3 --estimators precise")
    assert {"seed", "commit", "versions", "parameters"} <= set(found)
    assert found["summary"]["precise"]["found_within_0.5_m"] == 2


def test_finished_experiments(tmp_path):
    path = tmp_path / ".all.unfinished.json"
    (tmp_path / "e1.json").write_text("{}")
    (tmp_path / "e2.json").write_text("{}")
    done = FinishedExperiments(path, [0, 1])
    done.add("e1")
    done.add("e2")
    (tmp_path / "e2.json").write_text('{"other": 1}')
    again = FinishedExperiments(path, [0, 1])
    assert again.has("e1")
    assert not again.has("e2")
    assert not again.has("e3")
    (tmp_path / "e1.json").unlink()
    assert not FinishedExperiments(path, [0, 1]).has("e1")
    assert not FinishedExperiments(path, [5, 1]).has("e1")
    path.write_text("x")
    assert not FinishedExperiments(path, [0, 1]).has("e1")
