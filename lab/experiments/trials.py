"""Runs numbered trials in worker processes; resumable."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from common.errors import UserError
from common.geometry.world import load_world
from common.versions import checkout_state
from lab.workers import pool
from presage.terminal.progress import LINE_INTERVAL_S

Job = TypeVar("Job")  # a frozen dataclass of plain values, because it is pickled and compared with stored jobs
TrialResult = dict[str, Any]  # can be written as JSON


def run_trials(
    name: str, trial: Callable[[Job], TrialResult], jobs: Sequence[Job], out: Path, workers: int, console: Console
) -> list[TrialResult]:
    """Runs ``trial`` on every job in worker processes. Returns the results in the order of the jobs.

    ``trial`` must be a module-level function whose result depends on its job alone. Finished trials are stored in
    ``out`` until all are done, so that after Ctrl-C the same command continues.
    """
    store = TrialStore(out / f".{name}.unfinished.jsonl", jobs)
    done = store.read()
    if done:
        console.print(f"{name}: continuing after {len(done)} of {len(jobs)} trials of an interrupted run")
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(name, total=len(jobs), completed=len(done))
        if not console.is_terminal:
            console.print(f"{name}: {len(jobs) - len(done)} trials", highlight=False)
        last_line_s = time.monotonic()

        def store_result(index: int, result: TrialResult) -> None:
            done[index] = result
            store.add(index, result)
            bar.advance(task)
            nonlocal last_line_s
            if not console.is_terminal and (now_s := time.monotonic()) - last_line_s >= LINE_INTERVAL_S:
                last_line_s = now_s
                console.print(f"{name}: {len(done)} of {len(jobs)} trials done", highlight=False)

        remaining = [index for index in range(len(jobs)) if index not in done]
        try:
            if workers == 1 or len(remaining) <= 1:
                for index in remaining:
                    store_result(index, trial(jobs[index]))
            else:
                _run_in_parallel(trial, jobs, remaining, min(workers, len(remaining)), store_result)
        except KeyboardInterrupt:
            console.print(f"{name}: {len(done)} of {len(jobs)} trials are kept; the same command continues from there")
            raise
    store.path.unlink(missing_ok=True)
    return [done[index] for index in range(len(jobs))]


def _run_in_parallel(
    trial: Callable[[Job], TrialResult],
    jobs: Sequence[Job],
    remaining: list[int],
    workers: int,
    store_result: Callable[[int, TrialResult], None],
) -> None:
    try:
        with pool(workers) as executor:
            futures = {executor.submit(trial, jobs[index]): index for index in remaining}
            for future in as_completed(futures):
                store_result(futures[future], future.result())
    except BrokenProcessPool:
        raise UserError(
            "a worker process was killed, perhaps for lack of memory; run the same command again to continue, with "
            "a smaller PRESAGE_WORKERS if memory is short"
        ) from None


def run_key(jobs: Sequence[Any]) -> str:
    """A digest of what the results of ``jobs`` depend on: values, files and ROS bags that they name, the checkout."""
    plain = [asdict(job) for job in jobs]
    files = {name: _digest(path) for name in set(_texts(plain)) if name and _is_input(path := Path(name))}
    text = json.dumps([checkout_state(), plain, files], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _texts(value: Any) -> Iterator[str]:
    """All texts and paths in nested dictionaries, lists and tuples."""
    if isinstance(value, dict | list | tuple):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _texts(each)
    elif isinstance(value, str | Path):
        yield str(value)


def _is_input(path: Path) -> bool:
    """Whether this is a file, or the folder of a ROS 2 bag; other folders are for results."""
    return path.is_file() or (path / "metadata.yaml").is_file()


def _digest(path: Path) -> str:
    """A digest of a file or ROS bag, or for a map of the world that it and its images describe."""
    if path.suffix in {".yaml", ".yml"}:
        with suppress(UserError):  # other settings
            return hashlib.sha256(load_world(str(path)).model_dump_json().encode()).hexdigest()
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    total = hashlib.sha256()
    for file in files:
        total.update(file.read_bytes())
    return total.hexdigest()


class TrialStore:
    """A file with the results of an unfinished run, one per line, valid for the same `run_key` only."""

    def __init__(self, path: Path, jobs: Sequence[Any]) -> None:
        """Stores the path and the jobs' key; the file is neither read nor written yet."""
        self.path = path
        self.key = run_key(jobs)

    def read(self) -> dict[int, TrialResult]:
        """Results by index. Ignores an incomplete last line; deletes a file of other jobs or another checkout."""
        done: dict[int, TrialResult] = {}
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

    def add(self, index: int, result: TrialResult) -> None:
        """Appends a result."""
        first = "" if self.path.exists() else self.key + "\n"
        with self.path.open("a", encoding="utf-8") as file:
            file.write(first + json.dumps([index, result]) + "\n")
