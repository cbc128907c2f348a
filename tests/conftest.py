"""What tests share: processes that are always ended, a router of their own, keys of their own."""

from __future__ import annotations

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

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Sample
from tests.fork_server import Child, ForkServer, die_with

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 30.0  # s, deadline of a wait for what takes well under a second on an idle machine
numbers = itertools.count(1)
fork_servers: list[ForkServer] = []  # one, once it is needed, for each of xdist's workers

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
    # Of these the engine's first: they take longest, and wait for it rather than for a core.
    items.sort(key=lambda item: ("system" in item.keywords, item.get_closest_marker("docker") is None))


@pytest.fixture(scope="session", autouse=True)
def _nothing_left_behind():
    """No test run leaves a process behind; asked for first, so torn down last, in each of xdist's workers."""
    yield
    while fork_servers:
        fork_servers.pop().close()
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


def taken(inbox, kind):
    """The messages of a kind that wait, out of the inbox one by one."""
    while isinstance(sample := inbox.get(0), Sample):
        message = sample.topic.message.decode(sample.payload)
        if isinstance(message, kind):
            yield message


def next_of(inbox, kind, condition, timeout=60.0):
    """The first message of a kind that meets a condition."""
    found = []

    def look():
        found.extend(itertools.islice(filter(condition, taken(inbox, kind)), 1))
        return bool(found)

    assert wait_until(look, timeout), f"no {kind.__name__} as wanted within {timeout:g} s"
    return found[0]


class Running:
    """A child process and the file with all it said."""

    def __init__(self, name: str, child: Child | subprocess.Popen, log: Path) -> None:
        self.name, self.child, self.log = name, child, log

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

    def start(self, name: str | Path, *args: str, env: dict[str, str] | None = None, fresh: bool = False) -> Running:
        """``simulator`` is services.simulator; a dotted name is a module, a path a script.

        ``fresh``: by an interpreter that begins anew, not by the fork server.
        """
        what = [str(name)] if isinstance(name, Path) else ["-m", name if "." in name else f"services.{name}"]
        # The checkout's modules, though the child runs in a folder of its own.
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        clean = {k: v for k, v in os.environ.items() if not k.startswith("PRESAGE_")}
        environment = {**clean, "PYTHONUNBUFFERED": "1", "PYTHONPATH": path, **(env or {})}
        log = self.folder / f"{len(self.started)}-{Path(str(name)).name}.log"
        running = Running(str(name), self._child([*what, *args], environment, log, fresh=fresh), log)
        self.started.append(running)
        return running

    def _child(self, what: list[str], environment: dict[str, str], log: Path, *, fresh: bool):
        if not fresh and sys.platform == "linux":
            if not fork_servers:
                fork_servers.append(ForkServer())
            return fork_servers[0].start(what, environment, log, self.folder)
        parent = os.getpid()  # pytest-timeout ends the process without a teardown
        with log.open("wb") as file:
            return subprocess.Popen(
                [sys.executable, *what], env=environment, cwd=self.folder, stdin=subprocess.DEVNULL, stdout=file,
                stderr=subprocess.STDOUT, preexec_fn=lambda: die_with(parent),  # noqa: PLW1509 - as in the server
            )  # fmt: skip

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
                process.child.wait(PATIENCE)
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

    def start(name, *args, env=None, fresh=False):
        talk = {"PRESAGE_CONNECT": link.connect[0], "PRESAGE_ROBOT": link.robot}
        return processes.start(name, *args, env={**talk, **(env or {})}, fresh=fresh)

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
