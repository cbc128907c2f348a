"""Processes without the cost of their imports: a server that has imported what the services use forks one a start.

What runs is the same module in a process of its own, by `runpy` as `python -m` does; hundreds of starts, each 0.6 s of
others' packages, are much of what the tests would cost. What needs a new interpreter is started with ``fresh=True``.
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

PRELOADED = (
    "common.router", "presage.cli.main", "services.controller.service", "services.estimator.service",
    "services.recorder.service", "services.simulator.service", "services.viewer.service",
)  # fmt: skip
OURS = {"common", "lab", "presage", "services", "worlds", "models"}
LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


def die_with(parent: int) -> None:
    """End when the process ``parent`` does, however it does."""
    if LIBC is not None:
        LIBC.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


class Child:
    """As much of subprocess.Popen as tests use."""

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
    """The server's process, as the tests' process sees it."""

    def __init__(self) -> None:
        command = [sys.executable, __file__]
        path = os.pathsep.join([str(Path(__file__).parent.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        parent = os.getpid()
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"},
            preexec_fn=lambda: die_with(parent),  # noqa: PLW1509 - no lock, no allocation in it
        )  # fmt: skip
        self._lock = threading.Lock()
        self._started = threading.Semaphore(0)
        self._last: Child | None = None
        self._children: dict[int, Child] = {}
        threading.Thread(target=self._listen, daemon=True).start()

    def start(self, what: list[str], environment: dict[str, str], log: Path, cwd: Path) -> Child:
        log.touch()  # whoever started it may look at once
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
        self._started.release()  # it has ended: nobody is to wait


def serve() -> dict | None:
    """Fork for each line of standard input; returns in the children, with what to run, and at the end, with None."""
    reports = os.dup(1)
    os.dup2(2, 1)  # what imports print is no report
    sys.path[0] = str(Path(__file__).parent.parent)  # not tests/, with its folders of the same names
    for name in PRELOADED:
        importlib.import_module(name)
    for name in [name for name in sys.modules if name.partition(".")[0] in OURS]:
        del sys.modules[name]  # what they import from others stays; they themselves begin anew in each process
    died, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the tests' own affair
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
                    _forget(me, (reports, died, wake))
                    return json.loads(line)
                os.write(reports, f"started {pid}\n".encode())


def _forget(server: int, descriptors: tuple[int, ...]) -> None:
    """In a child: be no server."""
    die_with(server)
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


def become(request: dict) -> None:
    """The module or script that is asked for, as if the interpreter had just begun with it."""
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
    if (asked := serve()) is not None:
        become(asked)
