"""`presage experiment all`."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rich.console import Console

from common.versions import checkout_state
from lab.experiments import results
from lab.pages import tables_page as page
from lab.paper import (
    aliasing,
    alpha_sweep,
    e1_localisation,
    e2_crossing,
    e3_navigation,
    prediction,
    samples,
    step_sizes,
)

Run = Callable[[], results.Result]


def run_all(trials: int, seed: int, out: Path, workers: int, console: Console) -> None:
    """Runs all experiments, except those already finished by an interrupted run of the same command and checkout.

    ``trials`` limits the number of trials of each experiment; 0 means each experiment's own number.
    """

    def limited(own: int) -> int:
        return min(own, trials) if trials else own

    def folder(name: str) -> Path:
        subfolder = out / name
        subfolder.mkdir(exist_ok=True)
        return subfolder

    e1_job = e1_localisation.LocalisationJob(0, seed, 50)
    e3_job = e3_navigation.PaperNavigationJob(0, seed)
    # Two variants: the paper's estimator with enough iterations to converge, and journeys without a free straight line.
    converged = e1_localisation.LocalisationJob(0, seed, 200, ("paper",))
    any_pair = e3_navigation.PaperNavigationJob(0, seed, limit=450, free=False, estimators=("precise",))
    runs: dict[str, Run] = {
        "e1": lambda: e1_localisation.run(e1_job, limited(100), out, workers, console),
        "converged/e1": lambda: e1_localisation.run(converged, limited(100), folder("converged"), workers, console),
        "e2": lambda: e2_crossing.run(e2_crossing.CrossingJob(0, seed), limited(12), out, workers, console),
        # One worker more, because processes in lockstep also wait for one another.
        "e3": lambda: e3_navigation.run(e3_job, limited(50), out, workers + 1, console),
        "any/e3": lambda: e3_navigation.run(any_pair, limited(10), folder("any"), workers, console),
        "alpha": lambda: alpha_sweep.run(e1_job, limited(25), out, workers, console),
        "steps": lambda: step_sizes.run(step_sizes.StepSizeJob(0, seed), limited(10), out, workers, console),
        "samples": lambda: samples.run(samples.SamplesJob(seed, places=limited(50)), out, workers, console),
        "aliasing": lambda: aliasing.run(aliasing.AliasingJob(seed, places=limited(30)), out, workers, console),
        "prediction": lambda: prediction.run(prediction.PredictionJob(seed), out, 1, console),
    }
    done = FinishedExperiments(out / ".all.unfinished.json", [trials, seed])
    began = time.monotonic()
    for number, (name, run) in enumerate(runs.items(), 1):
        if done.has(name):
            console.print(f"{name}: already done")
            continue
        console.rule(f"{number} of {len(runs)}: {name}", align="left")
        run()
        print(f"\n{page.table_of(name, out)}\n")
        done.add(name)
    done.path.unlink(missing_ok=True)
    console.print(f"all results are in {out}/, after {(time.monotonic() - began) / 60:.1f} minutes")


class FinishedExperiments:
    """A file with the experiments that an interrupted run of the same command and checkout has finished."""

    def __init__(self, path: Path, parameters: list[int]) -> None:
        """Reads the file if it exists and has the same ``parameters`` and `checkout_state`."""
        self.path, self.key = path, [checkout_state(), *parameters]
        self._done: dict[str, str] = {}  # by name, the digest of its result
        with suppress(OSError, ValueError, KeyError, TypeError):  # treat a damaged file as a missing one
            kept = json.loads(path.read_text(encoding="utf-8"))
            self._done = dict(kept["done"]) if kept["key"] == self.key else {}

    def has(self, name: str) -> bool:
        """Whether the experiment is finished and its result has not been changed since."""
        return name in self._done and self._digest(name) == self._done[name]

    def add(self, name: str) -> None:
        """Records that the experiment is finished."""
        self._done[name] = self._digest(name)
        fresh = self.path.with_suffix(".new")
        fresh.write_text(json.dumps({"key": self.key, "done": self._done}) + "\n", encoding="utf-8")
        fresh.replace(self.path)

    def _digest(self, name: str) -> str:
        result = self.path.parent / f"{name}.json"
        return hashlib.sha256(result.read_bytes()).hexdigest() if result.exists() else ""
