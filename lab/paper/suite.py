"""`presage experiment all`."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rich.console import Console

from common.versions import commit
from lab.experiments import results
from lab.experiments import tables_page as page
from lab.paper import aliasing, prediction, samples
from lab.paper import alpha_sweep as step_size
from lab.paper import e1_localisation as localisation
from lab.paper import e2_crossing as crossing
from lab.paper import e3_navigation as navigation
from lab.paper import step_sizes as stepping

Run = Callable[[], results.Result]


def run_all(trials: int, seed: int, out: Path, workers: int, console: Console) -> None:
    """Run what is not done yet by the same command at the same commit; ``trials`` 0: each experiment's own number."""

    def few(own: int) -> int:
        return min(own, trials) if trials else own

    def folder(name: str) -> Path:
        made = out / name
        made.mkdir(exist_ok=True)
        return made

    # The paper's estimator with all the time it wants, and journeys whose straight line need not be free.
    slow = localisation.Job(0, seed, 200, ("paper",))
    any_pair = navigation.Job(0, seed, limit=450, free=False, estimators=("precise",))
    runs: dict[str, Run] = {
        "e1": lambda: localisation.run(localisation.Job(0, seed, 50), few(100), out, workers, console),
        "converged/e1": lambda: localisation.run(slow, few(100), folder("converged"), workers, console),
        "e2": lambda: crossing.run(crossing.Job(0, seed), few(12), out, workers, console),
        # One more than cores: who is in lockstep also waits.
        "e3": lambda: navigation.run(navigation.Job(0, seed), few(50), out, workers + 1, console),
        "any/e3": lambda: navigation.run(any_pair, few(10), folder("any"), workers, console),
        "alpha": lambda: step_size.run(localisation.Job(0, seed, 50), few(25), out, workers, console),
        "steps": lambda: stepping.run(stepping.Job(0, seed), few(10), out, workers, console),
        "samples": lambda: samples.run(samples.Job(seed, places=few(50)), out, workers, console),
        "aliasing": lambda: aliasing.run(aliasing.Job(seed, places=few(30)), out, workers, console),
        "prediction": lambda: prediction.run(prediction.Job(seed), out, 1, console),
    }
    done = FinishedExperiments(out / ".all.unfinished.json", [trials, seed])
    began = time.monotonic()
    for number, (name, run) in enumerate(runs.items(), 1):
        if done.has(name):
            console.print(f"{name}: done before")
            continue
        console.rule(f"{number} of {len(runs)}: {name}", align="left")
        run()
        print(f"\n{page.table_of(name, out)}\n")
        done.add(name)
    done.path.unlink(missing_ok=True)
    console.print(f"all of it lies in {out}/; {(time.monotonic() - began) / 60:.1f} minutes")


class FinishedExperiments:
    """Names of the experiments that an interrupted run has finished; those of another command or commit count not."""

    def __init__(self, path: Path, parameters: list[int]) -> None:
        """Read what is there."""
        self.path, self.key = path, [commit(), *parameters]
        self._done: dict[str, str] = {}  # by name, the digest of its result
        with suppress(OSError, ValueError, KeyError, TypeError):  # a damaged file is as good as none
            kept = json.loads(path.read_text(encoding="utf-8"))
            self._done = dict(kept["done"]) if kept["key"] == self.key else {}

    def has(self, name: str) -> bool:
        """Whether it is done, and its result still is the one that was written."""
        return name in self._done and self._digest(name) == self._done[name]

    def add(self, name: str) -> None:
        """One more."""
        self._done[name] = self._digest(name)
        fresh = self.path.with_suffix(".new")
        fresh.write_text(json.dumps({"key": self.key, "done": self._done}) + "\n", encoding="utf-8")
        fresh.replace(self.path)

    def _digest(self, name: str) -> str:
        result = self.path.parent / f"{name}.json"
        return hashlib.sha256(result.read_bytes()).hexdigest() if result.exists() else ""
