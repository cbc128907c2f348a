"""What tests share: processes that are always ended, a router of their own, keys of their own."""

from __future__ import annotations

import ctypes
import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import hypothesis
import psutil
import pytest

from common.bus import Link, open_bus, wait_until
from common.inbox import Sample

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 30.0  # s, deadline of a wait for what takes well under a second on an idle machine
LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
numbers = itertools.count(1)

# No database: nothing is written into the checkout. In CI the examples are the same every time.
# `pytest --hypothesis-profile thorough` looks longer than every run can.
EXAMPLES = 50
hypothesis.settings.register_profile("local", deadline=None, database=None, max_examples=EXAMPLES)
hypothesis.settings.register_profile(
    "ci", deadline=None, database=None, max_examples=EXAMPLES, derandomize=True, print_blob=True
)
hypothesis.settings.register_profile("thorough", deadline=None, database=None, max_examples=1000)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")


def pytest_collection_modifyitems(items):
    """Fast tests first: those that drive processes come last and carry the mark."""
    for item in items:
        if (ROOT / "tests" / "system") in item.path.parents:
            item.add_marker(pytest.mark.system)
    items.sort(key=lambda item: (item.get_closest_marker("docker") is not None, "system" in item.keywords))


@pytest.fixture(scope="session", autouse=True)
def _nothing_left_behind():
    """No test run leaves a process behind; asked for first, so torn down last, in each of xdist's workers."""
    yield
    # Python's own resource tracker, once a pool was spawned, ends with us.
    left = [c for c in psutil.Process().children(recursive=True) if "resource_tracker" not in " ".join(c.cmdline())]
    for child in left:
        print(f"\nleft behind: {child}", file=sys.stderr)
        child.kill()
    assert not left


@pytest.fixture(autouse=True)
def _no_settings_from_outside(monkeypatch):
    for name in [name for name in os.environ if name.startswith("PRESAGE_")]:
        monkeypatch.delenv(name)


def free_tcp_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def accepts(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def free_port():
    """Calls give TCP ports of loopback that are free now."""
    return free_tcp_port


def next_of(inbox, kind, condition, timeout=60.0):
    """The first message of a kind that meets a condition."""
    found = []

    def look():
        while isinstance(sample := inbox.get(0), Sample):
            message = sample.topic.message.decode(sample.payload)
            if isinstance(message, kind) and condition(message):
                found.append(message)
                return True
        return False

    assert wait_until(look, timeout), f"no {kind.__name__} as wanted within {timeout:g} s"
    return found[0]


class Running:
    """A child process and the file with all it said."""

    def __init__(self, name: str, command: list[str], environment: dict[str, str], log: Path, cwd: Path) -> None:
        self.name, self.log = name, log
        parent = os.getpid()

        def die_with_parent():  # pytest-timeout ends the process without a teardown
            if LIBC is not None and hasattr(LIBC, "prctl"):
                LIBC.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
                if os.getppid() != parent:
                    os._exit(1)

        with log.open("wb") as file:
            self.child = subprocess.Popen(
                command, env=environment, cwd=cwd, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                preexec_fn=die_with_parent,  # noqa: PLW1509 - no lock, no allocation in it
            )  # fmt: skip

    @property
    def output(self) -> str:
        return self.log.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self.child.poll() is None

    def wait_for(self, text: str, timeout: float = PATIENCE) -> None:
        """Until it has said ``text``."""
        wait_until(lambda: text in self.output or not self.running, timeout)
        assert text in self.output, f"{self.name} did not say {text!r}:\n{self.output}"

    def wait(self, timeout: float = PATIENCE) -> int:
        """Its status, once it ends by itself."""
        try:
            return self.child.wait(timeout)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{self.name} did not end within {timeout:g} s:\n{self.output}")

    def send(self, number: int) -> None:
        self.child.send_signal(number)

    def stop(self, number: int = signal.SIGTERM, timeout: float = 10.0) -> tuple[int, float]:
        """Ask it to end: its status, and the seconds it took."""
        began = time.monotonic()
        self.send(number)
        return self.wait(timeout), time.monotonic() - began

    def kill(self) -> None:
        self.child.kill()
        self.child.wait()


class Processes:
    """Starts children; `close` ends them all and says which had to be killed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.started = folder, []

    def start(self, name: str | Path, *args: str, env: dict[str, str] | None = None) -> Running:
        """``simulator`` is services.simulator; a dotted name is a module, a path a script."""
        what = [str(name)] if isinstance(name, Path) else ["-m", name if "." in name else f"services.{name}"]
        # The checkout's modules, though the child runs in a folder of its own.
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        clean = {k: v for k, v in os.environ.items() if not k.startswith("PRESAGE_")}
        environment = {**clean, "PYTHONUNBUFFERED": "1", "PYTHONPATH": path, **(env or {})}
        log = self.folder / f"{len(self.started)}-{Path(str(name)).name}.log"
        running = Running(str(name), [sys.executable, *what, *args], environment, log, self.folder)
        self.started.append(running)
        return running

    def start_router(self) -> tuple[Running, int]:
        """A router that listens, and its port; another port where somebody was quicker."""
        for _ in range(5):
            port = free_tcp_port()
            running = self.start("common.router", "--listen", f"tcp/127.0.0.1:{port}")
            wait_until(lambda r=running, p=port: not r.running or accepts(p), PATIENCE)
            if running.running:
                return running, port
        raise AssertionError(f"no router started:\n{running.output}")

    def close(self) -> None:
        killed = []
        for process in self.started:
            if process.running:
                process.send(signal.SIGCONT)
                process.send(signal.SIGTERM)
        for process in self.started:
            try:
                process.child.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                killed.append(process)
        assert not killed, "\n".join(f"{p.name} had to be killed; it said:\n{p.output}" for p in killed)


@pytest.fixture(scope="module")
def router(tmp_path_factory):
    """Port of a router process."""
    processes = Processes(tmp_path_factory.mktemp("router"))
    try:
        yield processes.start_router()[1]
    finally:
        processes.close()


@pytest.fixture
def link(router):
    """A session's settings: this module's router, a robot name no other test has."""
    return Link(robot=f"test{next(numbers)}", connect=(f"tcp/127.0.0.1:{router}",))


@pytest.fixture
def bus(link):
    """An open session that has found the router."""
    with open_bus(link) as session:
        assert wait_until(session.linked, PATIENCE)
        yield session


@pytest.fixture
def process(tmp_path, link):
    """Calls start processes that talk to this test's robot over its router; all are ended after the test."""
    processes = Processes(tmp_path)

    def start(name, *args, env=None):
        talk = {"PRESAGE_CONNECT": link.connect[0], "PRESAGE_ROBOT": link.robot}
        return processes.start(name, *args, env={**talk, **(env or {})})

    try:
        yield start
    finally:
        processes.close()


@pytest.fixture
def processes(tmp_path):
    """The same without a router: for tests of routers, and of what fails before it talks."""
    made = Processes(tmp_path)
    try:
        yield made
    finally:
        made.close()
