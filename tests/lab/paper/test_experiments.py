"""Trials, results and the results page of the experiments, and small runs of E1 and E2."""

from __future__ import annotations

import json
import re
import signal
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import shapely
from rich.console import Console

from common.bus.bus import wait_until
from common.errors import UserError
from lab.accuracy.scenes import Scene
from lab.experiments import results
from lab.experiments import tables_page as page
from lab.experiments.estimators import PAPER_DESCENT, ExperimentWorld, parse_estimators
from lab.experiments.trials import TrialStore, run_trials
from lab.paper import alpha_sweep as step_size
from lab.paper import e1_localisation as localisation
from lab.paper import e2_crossing as crossing
from lab.paper.suite import FinishedExperiments

QUIET = Console(quiet=True)


@dataclass(frozen=True)
class Count:
    index: int
    folder: str
    fails_at: int = -1


def count(job):
    """A trial that records its execution in a file, and may fail."""
    if job.index == job.fails_at and not (Path(job.folder) / "mended").exists():
        raise ValueError("as asked")
    with (Path(job.folder) / "ran").open("a") as file:
        file.write(f"{job.index}\n")
    return {"square": job.index**2}


def jobs(folder, **more):
    return [Count(index, str(folder), **more) for index in range(6)]


@pytest.mark.parametrize("workers", [1, 2])
def test_results_are_in_the_order_of_the_jobs(tmp_path, workers):
    rows = run_trials("count", count, jobs(tmp_path), tmp_path, workers, QUIET)
    assert [row["square"] for row in rows] == [0, 1, 4, 9, 16, 25]
    assert sorted((tmp_path / "ran").read_text().split()) == list("012345")
    assert [path.name for path in tmp_path.iterdir()] == ["ran"]


def test_an_interrupted_run_continues(tmp_path):
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


def test_results_of_other_jobs_are_ignored(tmp_path):
    path = tmp_path / "store"
    TrialStore(path, jobs(tmp_path)).add(0, {"square": 99})
    assert TrialStore(path, jobs(tmp_path, fails_at=3)).read() == {}
    assert not path.exists()


def test_an_incomplete_last_line_is_ignored(tmp_path):
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


def test_a_trial_depends_on_its_job_alone():
    alone = localisation.trial(small(1))
    localisation.trial(small(0))
    assert localisation.trial(small(1)) == alone
    assert localisation.trial(small(2))["pose"] != alone["pose"]


def test_precise_needs_one_scan_where_the_papers_descent_converges_slowly():
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


def test_the_crossing_path_is_free_and_straight():
    scene = ExperimentWorld().scene(3, 4)
    path = crossing.path_of(scene, 1.0, 0.05)
    assert (scene.world.clearance(path[:, :2]) > 0.37).all()
    assert np.allclose(np.diff(path, axis=0), [0.05, 0, 0])
    assert path[-1, 0] - path[0, 0] > 16


def test_a_world_without_a_free_line_is_refused():
    scene = Scene.of(ExperimentWorld("maze").scene(0).world, 622, 0)
    assert shapely.area(scene.world.free_space) > 0
    with pytest.raises(UserError, match="no free straight line"):
        crossing.path_of(scene, 0.0, 0.05)


def test_precise_follows_the_crossing_with_and_without_odometry():
    job = crossing.CrossingJob(0, 2, 0.2, ("precise", "precise, odometry"))
    found = crossing.trial(job)
    assert found == crossing.trial(job)
    assert max(found["error_m"]["precise, odometry"]) < 0.02
    assert np.median(found["error_m"]["precise"]) < 0.005


def test_the_best_step_size_finds_the_most_places():
    rows = {
        "a": {"steps_a_scan": 1, "alpha_m2": 1.0, "found_within_0.2_m": 3, "final_error_median_m": 0.1},
        "b": {"steps_a_scan": 1, "alpha_m2": 2.0, "found_within_0.2_m": 4, "final_error_median_m": 0.2},
        "c": {"steps_a_scan": 1, "alpha_m2": 3.0, "found_within_0.2_m": 4, "final_error_median_m": 0.1},
        "d": {"steps_a_scan": 10, "alpha_m2": 4.0, "found_within_0.2_m": 9, "final_error_median_m": 0.1},
    }
    assert step_size.best(rows, 1) == 3.0


def test_estimator_names_are_parsed():
    assert parse_estimators("paper,particle-filter heading known") == ("paper", "particle-filter, heading known")
    with pytest.raises(UserError, match="no estimator 'kalman'"):
        parse_estimators("paper,kalman")


def test_a_page_is_filled_from_results_and_missing_results_are_reported(tmp_path):
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


@pytest.mark.parametrize("name", ["experiments", "real_logs", "navigation"])
def test_tables_of_a_page(name):
    docs = Path(__file__).resolve().parents[3] / "docs"
    text = (docs / f"{name}.md").read_text(encoding="utf-8")
    assert "<!-- table " in text
    assert page.fill_tables(text, docs / "experiments") == text


def test_the_command_writes_all_files_and_is_reproducible(process, tmp_path):
    summaries = []
    for folder, workers in (("a", "1"), ("b", "2")):
        run = process(
            "presage.__main__", "experiment", "e1", "--trials", "2", "--iterations", "3", "--estimators",
            "precise,particle-filter", "--out", str(tmp_path / folder), env={"PRESAGE_WORKERS": workers},
        )  # fmt: skip
        assert run.wait(120) == 0, run.output
        names = {path.name for path in (tmp_path / folder).iterdir()}
        assert names == {"e1.json", "e1.csv", "e1.trials.jsonl", "e1.pdf", "e1.png"}
        told = json.loads((tmp_path / folder / "e1.json").read_text())
        assert told["command"].startswith("presage experiment e1 --trials 2")
        assert {"seed", "commit", "versions", "parameters"} <= set(told)
        summaries.append((told["summary"], (tmp_path / folder / "e1.csv").read_bytes()))
    assert summaries[0] == summaries[1]


def test_a_killed_run_leaves_no_workers(process, tmp_path):
    run = process(
        "presage.__main__", "experiment", "e1", "--trials", "40", "--estimators", "particle-filter", "--out",
        str(tmp_path), env={"PRESAGE_WORKERS": "2"},
    )  # fmt: skip
    store = tmp_path / ".e1.unfinished.jsonl"
    assert wait_until(lambda: store.exists() and len(store.read_text().splitlines()) > 1, 90), run.output
    workers = psutil.Process(run.child.pid).children(recursive=True)
    assert len(workers) >= 2
    run.kill()
    _, alive = psutil.wait_procs(workers, 20)
    for left in alive:
        left.kill()
    assert not alive


def test_the_same_command_continues_after_ctrl_c(process, tmp_path):
    args = ("presage.__main__", "experiment", "e1", "--trials", "40", "--iterations", "20", "--estimators",
            "particle-filter", "--out", str(tmp_path))  # fmt: skip
    run, store = process(*args, env={"PRESAGE_WORKERS": "2"}), tmp_path / ".e1.unfinished.jsonl"
    assert wait_until(lambda: store.exists() and len(store.read_text().splitlines()) > 3, 90), run.output
    run.send(signal.SIGINT)
    assert run.wait(30) == 130, run.output
    done = len(store.read_text().splitlines()) - 1
    run = process(*args, env={"PRESAGE_WORKERS": "2"})
    assert wait_until(lambda: "continuing after" in run.output, 60), run.output
    found = re.search(r"continuing after (\d+) of 40", run.output)
    assert found
    assert int(found[1]) == done
    run.send(signal.SIGINT)
    assert run.wait(30) == 130, run.output


def test_all_repeats_experiments_whose_results_have_changed(tmp_path):
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


@pytest.mark.parametrize("args", [("e1", "--alpha", "nan"), ("e1", "--trials", "0")])
def test_invalid_arguments_are_refused_before_anything_runs(process, tmp_path, args):
    run = process("presage.__main__", "experiment", *args, "--out", str(tmp_path / "out"))
    assert run.wait(60) == 2, run.output
    assert "Traceback" not in run.output
