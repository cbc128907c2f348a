"""Starts processes quickly: a server has imported the third-party packages already and forks for every start.

The child runs the module with `runpy`, as `python -m` does. Otherwise each of hundreds of starts would take 0.6 s for
imports, much of the tests' time. Tests that need a new interpreter use ``fresh=True``.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

PRELOADED_MODULES = (
    "common.router", "presage.cli.main", "services.controller.service", "services.estimator.service",
    "services.recorder.service", "services.simulator.service", "services.viewer.service",
)  # fmt: skip
PROJECT_PACKAGES = {"common", "lab", "models", "presage", "services", "worlds"}
LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


def end_with_parent(parent: int) -> None:
    """Ends this process when the process ``parent`` ends, however it ends."""
    if LIBC is not None:
        LIBC.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


class Child:
    """A forked process, with those methods of subprocess.Popen that tests use."""

    def __init__(self, pid: int) -> None:
        self.pid, self.returncode = pid, None
        self._ended = threading.Event()

    def end(self, returncode: int) -> None:
        self.returncode = returncode
        self._ended.set()

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        if not self._ended.wait(timeout):
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """Client of the fork server in the process that runs the tests."""

    def __init__(self) -> None:
        command = [sys.executable, __file__]
        path = os.pathsep.join([str(Path(__file__).parent.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        parent = os.getpid()
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"},
            preexec_fn=lambda: end_with_parent(parent),  # noqa: PLW1509 - no lock, no allocation in it
        )  # fmt: skip
        self._lock = threading.Lock()
        self._started = threading.Semaphore(0)
        self._last: Child | None = None
        self._children: dict[int, Child] = {}
        threading.Thread(target=self._listen, daemon=True).start()

    def start(self, what: list[str], environment: dict[str, str], log: Path, cwd: Path) -> Child:
        log.touch()  # so that the caller can read it at once
        with self._lock:
            request = {"what": what, "environment": environment, "log": str(log), "cwd": str(cwd)}
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
            if not self._started.acquire(timeout=60) or self._last is None:
                raise RuntimeError("the tests' fork server does not answer")
            child, self._last = self._last, None
            return child

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(10)
        self.process.stdout.close()

    def _listen(self) -> None:
        for line in self.process.stdout:
            kind, *numbers = line.split()
            if kind == "started":
                self._last = self._children[int(numbers[0])] = Child(int(numbers[0]))
                self._started.release()
            else:
                self._children.pop(int(numbers[0])).end(int(numbers[1]))
        self._started.release()  # the server has ended, so wake up a waiting caller


def serve() -> dict | None:
    """Forks for each request on standard input. Returns the request in the children, None in the server at the end."""
    reports = os.dup(1)
    os.dup2(2, 1)  # keep output of imports out of the reports
    sys.path[0] = str(Path(__file__).parent.parent)  # instead of tests/, which has folders of the same names
    for name in PRELOADED_MODULES:
        importlib.import_module(name)
    for name in [name for name in sys.modules if name.partition(".")[0] in PROJECT_PACKAGES]:
        del sys.modules[
            name
        ]  # third-party packages stay imported; the project's modules are imported again in each child
    died, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the tests' process
    pending, me = b"", os.getpid()
    while True:
        ready, _, _ = select.select([0, died], [], [])
        if died in ready:
            os.read(died, 4096)
            while (ended := _reap()) is not None:
                os.write(reports, f"ended {ended[0]} {ended[1]}\n".encode())
        if 0 in ready:
            if not (read := os.read(0, 65536)):
                return None
            *lines, pending = (pending + read).split(b"\n")
            for line in lines:
                if (pid := os.fork()) == 0:
                    _leave_server(me, (reports, died, wake))
                    return json.loads(line)
                os.write(reports, f"started {pid}\n".encode())


def _leave_server(server: int, descriptors: tuple[int, ...]) -> None:
    """Restores normal signal handling in a child and closes the server's descriptors."""
    end_with_parent(server)
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for descriptor in descriptors:
        os.close(descriptor)


def _reap() -> tuple[int, int] | None:
    try:
        pid, status = os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:
        return None
    return (pid, os.waitstatus_to_exitcode(status)) if pid else None


def run_request(request: dict) -> None:
    """Runs the requested module or script as if the interpreter had been started with it."""
    log = os.open(request["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for target, source in ((0, nothing), (1, log), (2, log)):
        os.dup2(source, target)
    os.close(log)
    os.close(nothing)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environment"])
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True, write_through=True)
    if hasattr(time, "tzset"):
        time.tzset()
    kind, *rest = request["what"]
    if kind == "-m":
        name, *sys.argv[1:] = rest
        sys.path[0] = request["cwd"]
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    else:
        sys.argv = [kind, *rest]
        sys.path[0] = str(Path(kind).parent)
        runpy.run_path(kind, run_name="__main__")


if __name__ == "__main__":
    if (request := serve()) is not None:
        run_request(request)
