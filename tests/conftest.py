"""Fixtures for all tests: child processes that are always ended, and a router and keys of their own."""

from __future__ import annotations

import itertools
import logging
import os
import signal
import socket
import subprocess
import sys
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import hypothesis
import psutil
import pytest
import structlog

from common.bus.bus import Link, open_bus, wait_until
from common.bus.inbox import Sample
from common.errors import UserError
from common.processes import end_with_this_process
from tests.fork_server import Child

ROOT = Path(__file__).resolve().parent.parent
WAIT_TIMEOUT_S = 300.0  # for events that take well under a second on an idle machine
numbers = itertools.count(1)

# Tests of what is not installed: PyTorch for preset paper, and pybullet for the simulator's physics.
TESTS_OF = {
    "torch": ("estimator/paper", "lab/paper", "lab/accuracy/test_panorama.py", "estimator/test_weights_files.py"),
    "pybullet": ("simulator/test_rays.py", "simulator/test_kinematics.py", "process_replay"),
}
MISSING = [package for package in TESTS_OF if find_spec(package) is None]
collect_ignore = [path for package in MISSING for path in TESTS_OF[package]]

# Without a database, so that nothing is written into the checkout. In CI the examples are the same every time.
# `pytest --hypothesis-profile thorough` tries more examples than a normal run has time for.
EXAMPLES = 50
hypothesis.settings.register_profile("local", deadline=None, database=None, max_examples=EXAMPLES)
hypothesis.settings.register_profile(
    "ci", deadline=None, database=None, max_examples=EXAMPLES, derandomize=True, print_blob=True
)
hypothesis.settings.register_profile("thorough", deadline=None, database=None, max_examples=1000)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")


def pytest_report_header():
    return [f"not installed: {package}; left out: {', '.join(TESTS_OF[package])}" for package in MISSING]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup():
    return (yield from skip_without_package())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    return (yield from skip_without_package())


def skip_without_package():
    """Skips a test that fails because one of the optional packages is missing."""
    try:
        return (yield)
    except (ModuleNotFoundError, UserError) as error:
        if any(text in str(error) for name in MISSING for text in (f"No module named '{name}", f"package {name} is")):
            pytest.skip(str(error))
        raise


def pytest_collection_modifyitems(items):
    """Marks tests/system. Runs files that start processes, which mostly wait, in turn with files that compute.

    Files that need Docker take longest, and come first. The order is reversed, because the files of tests/common are
    short, and fill the gaps at the end.
    """
    for item in items:
        if (ROOT / "tests" / "system") in item.path.parents:
            item.add_marker(pytest.mark.system)
    starting = {"processes", "module_processes", "router", "browser", "installed"}
    waiting = dict.fromkeys(item.path for item in items if starting & set(item.fixturenames))
    computing = dict.fromkeys(item.path for item in items if item.path not in waiting)
    place = {path: k / len(group) for group in (waiting, computing) for k, path in enumerate(reversed(group))}
    items.sort(key=lambda item: (item.get_closest_marker("docker") is None, place[item.path], item.path in computing))


@pytest.fixture(scope="session", autouse=True)
def _nothing_left_behind():
    """Fails if a test run leaves a process behind. Set up first and so torn down last, in each of xdist's workers."""
    yield
    # The fork server and the resource tracker of multiprocessing end with this process; their children must be gone.
    own = psutil.Process().children()
    helpers = [child for child in own if "from multiprocessing." in " ".join(child.cmdline())]
    left = [child for child in own if child not in helpers] + [c for h in helpers for c in h.children(recursive=True)]
    for child in left:
        print(f"\nleft behind: {child}", file=sys.stderr)
        child.kill()
    assert not left


@pytest.fixture(autouse=True)
def _no_settings_from_outside(monkeypatch, tmp_path):
    for name in [name for name in os.environ if name.startswith("PRESAGE_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PRESAGE_RUNTIME_DIR", str(tmp_path / "sessions"))


@pytest.fixture(autouse=True)
def _restored_logging():
    """Undoes the set-up of logging by commands that a test runs in this process, such as `presage replay --with`."""
    level = logging.root.level
    yield
    logging.root.setLevel(level)
    structlog.reset_defaults()


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
    """A function that returns a free TCP port of loopback."""
    return free_tcp_port


def received_messages(inbox, kind):
    """Takes the waiting messages out of the inbox; yields those of class ``kind``."""
    while isinstance(sample := inbox.get(0), Sample):
        message = sample.topic.message.decode(sample.payload)
        if isinstance(message, kind):
            yield message


def wait_for_message(inbox, kind, condition, timeout=WAIT_TIMEOUT_S):
    """Waits for the first message of class ``kind`` that meets a condition, and returns it."""
    matches = []

    def check():
        matches.extend(itertools.islice(filter(condition, received_messages(inbox, kind)), 1))
        return bool(matches)

    assert wait_until(check, timeout), f"no matching {kind.__name__} within {timeout:g} s"
    return matches[0]


def ended(process: psutil.Process) -> bool:
    """Whether a process that is no child of this one has ended; some machines reap such processes late."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


class Running:
    """A child process and the file with its output."""

    def __init__(self, name: str, child: Child | subprocess.Popen, log: Path) -> None:
        self.name, self.child, self.log = name, child, log

    @property
    def output(self) -> str:
        return self.log.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self.child.poll() is None

    def wait_for(self, text: str, timeout: float = WAIT_TIMEOUT_S) -> None:
        """Waits until the output contains ``text``."""
        wait_until(lambda: text in self.output or not self.running, timeout)
        assert text in self.output, f"{self.name} did not print {text!r}:\n{self.output}"

    def wait(self, timeout: float = WAIT_TIMEOUT_S) -> int:
        """Waits until the process ends by itself. Returns its exit status."""
        try:
            return self.child.wait(timeout)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{self.name} did not end within {timeout:g} s:\n{self.output}")

    def send(self, number: int) -> None:
        self.child.send_signal(number)

    def stop(self, number: int = signal.SIGTERM, timeout: float = WAIT_TIMEOUT_S) -> int:
        """Sends a signal and waits for the end. Returns the exit status."""
        self.send(number)
        return self.wait(timeout)

    def kill(self) -> None:
        self.child.kill()
        self.child.wait()


class Processes:
    """Starts child processes; `close` ends them all and fails if one had to be killed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.started = folder, []

    def start(self, name: str | Path, *args: str, env: dict[str, str] | None = None, fresh: bool = False) -> Running:
        """Starts a process: a plain name such as ``simulator`` is a service, a dotted name a module, a path a script.

        With ``fresh`` in a new interpreter instead of the fork server.
        """
        what = [str(name)] if isinstance(name, Path) else ["-m", name if "." in name else f"services.{name}"]
        # The child imports the checkout's modules although it runs in another folder.
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        clean = {k: v for k, v in os.environ.items() if not k.startswith("PRESAGE_")}
        environment = {**clean, "PYTHONUNBUFFERED": "1", "PYTHONPATH": path}
        environment |= {"PRESAGE_RUNTIME_DIR": str(self.folder / "sessions"), **(env or {})}
        log = self.folder / f"{len(self.started)}-{Path(str(name)).name}.log"
        running = Running(str(name), self._child([*what, *args], environment, log, fresh=fresh), log)
        self.started.append(running)
        return running

    def _child(self, what: list[str], environment: dict[str, str], log: Path, *, fresh: bool):
        if not fresh and sys.platform == "linux":
            return Child(what, environment, log, self.folder)
        with log.open("wb") as file:
            return subprocess.Popen(
                [sys.executable, *what],
                env=environment,
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                preexec_fn=end_with_this_process(signal.SIGKILL),  # pytest-timeout ends this process without a teardown
            )

    def start_router(self, *args: str) -> tuple[Running, int]:
        """Starts a router. Returns it and its port; tries another port if a process has just taken the first one."""
        for _ in range(5):
            port = free_tcp_port()
            running = self.start("common.router", "--listen", f"tcp/127.0.0.1:{port}", *args)
            # Not by connecting to the port: another test's router may have just taken it.
            wait_until(lambda r=running: not r.running or "router listens" in r.output, WAIT_TIMEOUT_S)
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
                process.child.wait(WAIT_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                killed.append(process)
        assert not killed, "\n".join(f"{p.name} had to be killed; its output:\n{p.output}" for p in killed)


@pytest.fixture(scope="module")
def router(tmp_path_factory):
    """Port of a router process, one for each test module."""
    with closing(Processes(tmp_path_factory.mktemp("router"))) as started:
        yield started.start_router()[1]


@pytest.fixture
def link(router):
    """Settings of a session: this module's router, and a robot name that no other test uses."""
    return Link(robot=f"test{next(numbers)}", connect=(f"tcp/127.0.0.1:{router}",))


@pytest.fixture
def bus(link):
    """An open session that is connected to the router."""
    with open_bus(link) as session:
        assert wait_until(session.linked, WAIT_TIMEOUT_S)
        yield session


@pytest.fixture
def process(tmp_path, link):
    """A function that starts processes of this test's robot, connected to its router. They end after the test."""
    with closing(Processes(tmp_path)) as started:

        def start(name, *args, env=None, fresh=False):
            talk = {"PRESAGE_CONNECT": link.connect[0], "PRESAGE_ROBOT": link.robot}
            return started.start(name, *args, env={**talk, **(env or {})}, fresh=fresh)

        yield start


@pytest.fixture
def processes(tmp_path):
    """Starts processes without a router, for tests of routers and of processes that fail before they connect."""
    with closing(Processes(tmp_path)) as started:
        yield started


@pytest.fixture(scope="module")
def module_processes(tmp_path_factory):
    """Starts processes that all tests of a module share."""
    with closing(Processes(tmp_path_factory.mktemp("module"))) as started:
        yield started


@pytest.fixture
def presage(monkeypatch, capsys):
    """A function that runs a command of the command line in this process. Returns its exit status and its output."""
    from presage.cli.main import main  # most tests do not need its many imports

    def run(*args):
        monkeypatch.setattr(sys, "argv", ["presage", *args])
        with pytest.raises(SystemExit) as end:
            main()
        return end.value.code or 0, "".join(capsys.readouterr())

    return run
