"""The table of faults."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from common.errors import UserError
from lab.fault_injection.hosts import run
from lab.fault_injection.system import System

LEASE = 3.0  # s after which a silent session is given up (common/bus/bus.py)
FAKETIME = ("/usr/lib/*/faketime/libfaketimeMT.so.1", "/usr/lib64/faketime/libfaketimeMT.so.1")
TINY = "2m"  # of a full disk


@dataclass(frozen=True)
class Fault:
    """One row."""

    name: str
    about: str
    begin: Callable[[System], None]
    end: Callable[[System], None]  # returns when the part has returned
    expect: Literal["stops", "goes on", "survives"]  # survives: whether it drives meanwhile is the network's affair
    lasts: float = 1.0  # s, or until the robot stands where that takes longer
    services: tuple[str, ...] = ()  # whose return is looked for
    base: bool = False  # the robot itself is what fails: nothing is seen of it meanwhile
    again: bool = False  # its process is a new one afterwards
    hosts: bool = False  # needs more than one
    why_not: Callable[[], str] = lambda: ""  # what else is missing here


def killed(*names: str, stops: bool = True) -> Fault:
    """SIGKILL, and started again."""
    return Fault(
        f"killed: {' + '.join(names)}", "SIGKILL; started again once the robot stands" if stops else "SIGKILL",
        lambda system: system.kill(*names),
        lambda system: system.restart(*names),
        "stops" if stops else "goes on", services=names, base="simulator" in names, again=names != ("router",),
    )  # fmt: skip


def frozen(name: str, lasts: float, *, stops: bool = True) -> Fault:
    """SIGSTOP and SIGCONT."""
    return Fault(
        f"frozen {lasts:g} s: {name}", "SIGSTOP, then SIGCONT",
        lambda system: system.signal(name, signal.SIGSTOP),
        lambda system: system.signal(name, signal.SIGCONT),
        "stops" if stops else "goes on", lasts, (name,), base=name == "simulator",
    )  # fmt: skip


def cut(seconds: float) -> Fault:
    """The robot's host loses its link."""

    def begin(system: System) -> None:
        assert system.network is not None  # noqa: S101 - the row needs hosts
        system.network.cut("robot")

    return Fault(f"network cut {seconds:g} s", "the robot's host loses its link", begin, _mend, "stops", seconds,
                 hosts=True)  # fmt: skip


def _mend(system: System) -> None:
    assert system.network is not None  # noqa: S101
    system.network.mend("robot")


def _worsen(system: System) -> None:
    assert system.network is not None  # noqa: S101
    system.network.worsen("robot", delay_ms=50, jitter_ms=20, loss=0.1)


def _skew(system: System) -> None:
    """The estimator's host has another time."""
    system.kill("estimator")
    system.extra["estimator"] = {"LD_PRELOAD": _faketime(), "FAKETIME": "+60s", "DONT_FAKE_MONOTONIC": "1"}


def _unskew(system: System) -> None:
    system.restart("estimator")


def _faketime() -> str:
    for pattern in FAKETIME:
        root, rest = Path("/"), pattern.lstrip("/")
        for path in root.glob(rest):
            return str(path)
    return ""


def _second(service: str) -> Fault:
    """Another instance, by mistake."""

    def begin(system: System) -> None:
        system.start_module(f"second {service}", service, *system.arguments[service])

    return Fault(f"a second {service}", "started by mistake: it is named, and stands by", begin,
                 lambda system: system.kill(f"second {service}"), "goes on", 6.0)  # fmt: skip


def _helper(what: str, *args: str) -> tuple[Callable[[System], None], Callable[[System], None]]:
    """A troublemaker of lab.fault_injection.misbehaving_peers, at the router's host."""

    def begin(system: System) -> None:
        system.start_python(what, f"from lab.fault_injection.misbehaving_peers import main; main({[what, *args]!r})")

    def end(system: System) -> None:
        process = system.processes[what]
        status = process.child.poll()
        if status not in (None, 0):
            raise UserError(f"{what} ended with status {status}: {process.lines[-1] if process.lines else ''}")
        system.kill(what)

    return begin, end


def _fill(system: System) -> None:
    """A second recorder, on a disk that is full before long."""
    disk = system.folder / "full"
    disk.mkdir(exist_ok=True)
    run("mount", "-t", "tmpfs", "-o", f"size={TINY}", "tmpfs", str(disk))
    (disk / "others").write_bytes(bytes(1_900_000))
    system.start_module("recorder on a full disk", "recorder", "--directory", str(disk))


def _empty(system: System) -> None:
    if "recorder on a full disk" in system.processes:
        system.kill("recorder on a full disk")
    disk = system.folder / "full"
    (disk / "others").unlink()
    written = sorted(disk.iterdir())
    subprocess.run(["cp", *map(str, written), str(system.folder)], check=True)  # noqa: S603, S607
    run("umount", str(disk))


def _no_faketime() -> str:
    return "" if _faketime() else "libfaketime is not installed (package faketime)"


def _linux() -> str:
    return "" if sys.platform == "linux" else "Linux alone"


REPEATS, SLOW, NOISE = _helper("repeater"), _helper("slow subscriber"), _helper("malformed", "100000")

FAULTS: tuple[Fault, ...] = (
    Fault("nothing", "to compare with", lambda _: None, lambda _: None, "goes on", 8.0),
    killed("estimator"),
    killed("controller"),
    killed("simulator"),
    killed("recorder", stops=False),
    killed("viewer", stops=False),
    killed("router", stops=False),
    killed("estimator", "controller"),
    killed("simulator", "estimator"),
    killed("router", "controller"),
    frozen("estimator", 1.0),
    frozen("estimator", LEASE + 2),
    frozen("controller", 1.0),
    frozen("controller", LEASE + 2),
    frozen("simulator", LEASE + 2),
    frozen("recorder", LEASE + 2, stops=False),
    frozen("viewer", LEASE + 2, stops=False),
    cut(1.0),
    cut(5.0),
    cut(30.0),
    Fault("bad network", "10 % of the packets lost, 100 ms there and back, jitter 20 ms, at the robot's host",
          _worsen, _mend, "survives", 20.0, hosts=True),
    Fault("clock a minute ahead", "of the estimator's host; killed, and started again with it", _skew, _unskew, "stops",
          services=("estimator",), again=True, why_not=_no_faketime),
    Fault("duplicates, late", "every scan, belief and command once more at once, and once more a second later",
          *REPEATS, "goes on", 6.0),
    _second("estimator"),
    _second("controller"),
    Fault("full disk", "of a recorder; what it wrote before can be read", _fill, _empty, "goes on", 8.0, hosts=True),
    Fault("slow subscriber", "takes 0.2 s over every message of every topic", *SLOW, "goes on", 8.0),
    Fault("malformed", "100 000 payloads of noise, as fast as they go, over all topics", *NOISE, "survives", 8.0),
)  # fmt: skip
