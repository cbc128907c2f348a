"""The table of faults."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from common.errors import UserError
from lab.fault_injection.hosts import run
from lab.fault_injection.system import System
from lab.fault_injection.timeline import Row, is_error, is_standing_by

SESSION_LEASE_S = 3.0  # zenoh closes a silent session after this time (common/bus/bus.py)
FAKETIME_PATTERNS = ("/usr/lib/*/faketime/libfaketimeMT.so.1", "/usr/lib64/faketime/libfaketimeMT.so.1")
FULL_DISK_SIZE = "2m"  # for mount: 2 MiB
FULL_DISK_RECORDER = "recorder on a full disk"  # name of the process


@dataclass(frozen=True)
class Fault:
    """One fault: how to inject and end it, and what should happen."""

    name: str
    about: str
    begin: Callable[[System], None]
    end: Callable[[System], None]  # returns once the affected services are back
    # "stops": the robot must stop. "goes on": it must keep driving. "survives": it may do either, depending on the
    # network, but must drive afterwards.
    expect: Literal["stops", "goes on", "survives"]
    duration: float = 1.0  # s; longer if the robot takes longer to stop
    services: tuple[str, ...] = ()  # the affected services, whose recovery is measured
    stops_simulator: bool = False  # whether the simulator is affected, so that the robot cannot be observed
    restarts_process: bool = False  # whether a new process replaces the affected one
    needs_hosts: bool = False  # whether it needs several hosts
    unavailable_reason: Callable[[], str] = lambda: ""  # why it cannot be injected here; empty if it can
    # Whether an event shows that the system noticed the fault, besides those that `measure` knows for every fault.
    is_detection: Callable[[Row], bool] = lambda _: False


def killed(*names: str, stops: bool = True) -> Fault:
    """Services killed with SIGKILL and restarted."""
    return Fault(
        f"killed: {' + '.join(names)}",
        "SIGKILL; started again once the robot stands" if stops else "SIGKILL",
        lambda system: system.kill(*names),
        lambda system: system.restart(*names),
        "stops" if stops else "goes on",
        services=names,
        stops_simulator="simulator" in names,
        restarts_process=names != ("router",),
    )


def frozen(name: str, duration: float, *, stops: bool = True) -> Fault:
    """A service stopped with SIGSTOP and continued with SIGCONT."""
    return Fault(
        f"frozen {duration:g} s: {name}",
        "SIGSTOP, then SIGCONT",
        lambda system: system.signal(name, signal.SIGSTOP),
        lambda system: system.signal(name, signal.SIGCONT),
        "stops" if stops else "goes on",
        duration,
        (name,),
        stops_simulator=name == "simulator",
    )


def network_cut(seconds: float) -> Fault:
    """The link of the robot's host cut for a time."""

    def begin(system: System) -> None:
        assert system.network is not None  # noqa: S101 - guaranteed by needs_hosts
        system.network.cut("robot")

    return Fault(
        f"network cut {seconds:g} s",
        "the robot's host loses its link",
        begin,
        _restore_link,
        "stops",
        seconds,
        needs_hosts=True,
    )


def _restore_link(system: System) -> None:
    assert system.network is not None  # noqa: S101
    system.network.restore("robot")


def _degrade_link(system: System) -> None:
    assert system.network is not None  # noqa: S101
    system.network.degrade("robot", delay_ms=50, jitter_ms=20, loss=0.1)


def _kill_and_set_clock_ahead(system: System) -> None:
    system.kill("estimator")
    system.extra["estimator"] = {"LD_PRELOAD": _faketime(), "FAKETIME": "+60s", "DONT_FAKE_MONOTONIC": "1"}


def _restart_with_wrong_clock(system: System) -> None:
    system.restart("estimator")


def _faketime() -> str:
    for pattern in FAKETIME_PATTERNS:
        root, rest = Path("/"), pattern.lstrip("/")
        for path in root.glob(rest):
            return str(path)
    return ""


def second_instance(service: str) -> Fault:
    """A second instance of a service, as if started by mistake."""

    def begin(system: System) -> None:
        system.start_module(f"second {service}", service, *system.arguments[service])

    return Fault(
        f"a second {service}",
        "started by mistake: it reports the duplicate and stands by",
        begin,
        lambda system: system.kill(f"second {service}"),
        "goes on",
        6.0,
        is_detection=is_standing_by(f"second {service}"),
    )


def _misbehaving_peer(what: str, *args: str) -> tuple[Callable[[System], None], Callable[[System], None]]:
    """Functions that start and end a process of lab.fault_injection.misbehaving_peers on the router's host."""

    def begin(system: System) -> None:
        system.start_python(what, f"from lab.fault_injection.misbehaving_peers import main; main({[what, *args]!r})")

    def end(system: System) -> None:
        process = system.processes[what]
        status = process.child.poll()
        if status not in (None, 0):
            raise UserError(f"{what} ended with status {status}: {process.lines[-1] if process.lines else ''}")
        system.kill(what)

    return begin, end


def _start_recorder_on_full_disk(system: System) -> None:
    """Starts a second recorder on a disk that is soon full."""
    disk = system.folder / "full"
    disk.mkdir(exist_ok=True)
    run("mount", "-t", "tmpfs", "-o", f"size={FULL_DISK_SIZE}", "tmpfs", str(disk))
    (disk / "others").write_bytes(bytes(1_900_000))
    system.start_module(FULL_DISK_RECORDER, "recorder", "--directory", str(disk))


def _free_disk(system: System) -> None:
    if FULL_DISK_RECORDER in system.processes:
        system.kill(FULL_DISK_RECORDER)
    disk = system.folder / "full"
    (disk / "others").unlink()
    written = sorted(disk.iterdir())
    subprocess.run(["cp", *map(str, written), str(system.folder)], check=True)  # noqa: S603, S607
    run("umount", str(disk))


def _missing_faketime() -> str:
    return "" if _faketime() else "libfaketime is not installed (package faketime)"


REPEATER = _misbehaving_peer("repeater")
SLOW_SUBSCRIBER = _misbehaving_peer("slow subscriber")
NOISE = _misbehaving_peer("malformed", "100000")

FAULTS: tuple[Fault, ...] = (
    Fault("nothing", "no fault, for comparison", lambda _: None, lambda _: None, "goes on", 8.0),
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
    frozen("estimator", SESSION_LEASE_S + 2),
    frozen("controller", 1.0),
    frozen("controller", SESSION_LEASE_S + 2),
    frozen("simulator", SESSION_LEASE_S + 2),
    frozen("recorder", SESSION_LEASE_S + 2, stops=False),
    frozen("viewer", SESSION_LEASE_S + 2, stops=False),
    network_cut(1.0),
    network_cut(5.0),
    network_cut(30.0),
    Fault(
        "bad network",
        "at the robot's host: 10 % packet loss, 100 ms round trip, 20 ms jitter",
        _degrade_link,
        _restore_link,
        "survives",
        20.0,
        needs_hosts=True,
    ),
    Fault(
        "duplicates, late",
        "every scan, belief and command is repeated at once and again a second later",
        *REPEATER,
        "goes on",
        6.0,
    ),
    second_instance("estimator"),
    second_instance("controller"),
    Fault(
        "full disk",
        "a recorder's disk is full; what it wrote before remains readable",
        _start_recorder_on_full_disk,
        _free_disk,
        "goes on",
        8.0,
        needs_hosts=True,
        is_detection=is_error(FULL_DISK_RECORDER),
    ),
    Fault(
        "slow subscriber", "a subscriber to all topics takes 0.2 s for each message", *SLOW_SUBSCRIBER, "goes on", 8.0
    ),
    Fault("malformed", "100 000 random payloads on all topics, as fast as possible", *NOISE, "survives", 8.0),
    # The last one, because the clock of the estimator stays wrong.
    Fault(
        "clock a minute ahead",
        "the estimator is killed and restarted with a wrong clock",
        _kill_and_set_clock_ahead,
        _restart_with_wrong_clock,
        "stops",
        services=("estimator",),
        restarts_process=True,
        unavailable_reason=_missing_faketime,
    ),
)
