"""Starts child processes quickly: they are forked from multiprocessing's fork server, which has imported everything.

A child runs a module or script as `python -m` does, without the 0.6 s and more that imports take. Tests that need a new
interpreter, such as those that look at a command line, use ``fresh=True`` in conftest.py instead.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from pathlib import Path

from common.processes import end_with_parent

CONTEXT = multiprocessing.get_context("forkserver")
# Of presage only what it imports: its console reads the environment, which is another one in each child.
CONTEXT.set_forkserver_preload([
    "common.router", "rich.live", "rich.progress", "services.controller.service", "services.estimator.service",
    "services.recorder.service", "services.simulator.service", "services.viewer.service", "tests.preloaded", "typer",
])  # fmt: skip


class Child:
    """A forked process, with those methods of subprocess.Popen that tests use."""

    def __init__(self, what: list[str], environment: dict[str, str], log: Path, cwd: Path) -> None:
        log.touch()  # so that the caller can read it at once
        self._process = CONTEXT.Process(target=_run, args=(what, environment, str(log), str(cwd)))
        self._process.start()
        self.pid = self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        if self._process.exitcode is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _run(what: list[str], environment: dict[str, str], log: str, cwd: str) -> None:
    """In the child: runs ``what``, the arguments of an interpreter, with its output in the file ``log``."""
    end_with_parent(os.getppid(), signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the fork server ignores it
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored where the tests run under nohup
    multiprocessing.set_start_method(None, force=True)
    output = os.open(log, os.O_WRONLY | os.O_TRUNC)
    os.dup2(output, sys.stdout.fileno())
    os.dup2(output, sys.stderr.fileno())
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True, write_through=True)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    try:
        if what[0] == "-m":
            sys.argv[1:], sys.path[0] = what[2:], cwd
            runpy.run_module(what[1], run_name="__main__", alter_sys=True)
        else:
            sys.argv, sys.path[0] = what, str(Path(what[0]).parent)
            runpy.run_path(what[0], run_name="__main__")
    finally:
        atexit._run_exitfuncs()  # which multiprocessing skips; captured output is written to the log there
