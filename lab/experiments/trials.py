"""Runs numbered trials in worker processes; resumable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from common.errors import UserError
from common.versions import commit
from lab.workers import pool

Job = TypeVar("Job")  # a frozen dataclass of plain values: it is sent to a process, and it names its result
Result = dict[str, Any]  # plain values


def run_trials(
    name: str, trial: Callable[[Job], Result], jobs: Sequence[Job], out: Path, workers: int, console: Console
) -> list[Result]:
    """The result of every job, in their order; ``trial`` is a function of a module, and depends on its job alone.

    What is done is kept in ``out`` until all is done: the same command goes on there after Ctrl-C.
    """
    store = Store(out / f".{name}.unfinished.jsonl", jobs)
    done = store.read()
    if done:
        console.print(f"{name}: going on after {len(done)} of {len(jobs)} trials of an interrupted run")
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(name, total=len(jobs), completed=len(done))

        def keep(index: int, result: Result) -> None:
            done[index] = result
            store.add(index, result)
            bar.advance(task)

        left = [index for index in range(len(jobs)) if index not in done]
        try:
            if workers == 1 or len(left) <= 1:
                for index in left:
                    keep(index, trial(jobs[index]))
            else:
                _side_by_side(trial, jobs, left, min(workers, len(left)), keep)
        except KeyboardInterrupt:
            console.print(f"{name}: {len(done)} of {len(jobs)} trials are kept; the same command goes on there")
            raise
    store.path.unlink(missing_ok=True)
    return [done[index] for index in range(len(jobs))]


def _side_by_side(
    trial: Callable[[Job], Result], jobs: Sequence[Job], left: list[int], workers: int,
    keep: Callable[[int, Result], None],
) -> None:  # fmt: skip
    try:
        with pool(workers) as executor:
            futures = {executor.submit(trial, jobs[index]): index for index in left}
            for future in as_completed(futures):
                keep(futures[future], future.result())
    except BrokenProcessPool:
        raise UserError("a worker process was ended from outside (out of memory?); the same command goes on") from None


class Store:
    """Results of an unfinished run, a line each; those of other jobs or another commit are not taken."""

    def __init__(self, path: Path, jobs: Sequence[Any]) -> None:
        """Nothing is read or written yet."""
        self.path = path
        plain = json.dumps([commit(), [asdict(job) for job in jobs]], sort_keys=True, default=str)
        self.key = hashlib.sha256(plain.encode()).hexdigest()

    def read(self) -> dict[int, Result]:
        """By index; a last line cut short by a kill is left out."""
        done: dict[int, Result] = {}
        if not self.path.exists():
            return done
        lines = self.path.read_text(encoding="utf-8").splitlines()
        if not lines or lines[0] != self.key:
            self.path.unlink()
            return done
        for line in lines[1:]:
            try:
                index, result = json.loads(line)
            except ValueError:
                break
            done[int(index)] = result
        self.path.write_text("\n".join([self.key, *(json.dumps(pair) for pair in done.items())]) + "\n", "utf-8")
        return done

    def add(self, index: int, result: Result) -> None:
        """Keep one more."""
        first = "" if self.path.exists() else self.key + "\n"
        with self.path.open("a", encoding="utf-8") as file:
            file.write(first + json.dumps([index, result]) + "\n")
