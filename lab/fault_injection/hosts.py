"""Hosts as network namespaces.

Everything lives in a namespace of this process and of its children: nothing on the machine changes, and nothing is left
when they end, however they end.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import Self

from common.bus.bus import wait_until
from common.errors import UserError
from common.processes import end_with_parent

INSIDE = "PRESAGE_CHAOS_INSIDE"  # set in a process that has its own namespaces
SWITCH = "switch0"
NETWORK = "10.77.0"  # nobody else is in these namespaces


def why_no_hosts() -> str:
    """Empty where this machine lets us have network namespaces of our own; else what is missing."""
    for tool, package in (("unshare", "util-linux"), ("nsenter", "util-linux"), ("ip", "iproute2")):
        if shutil.which(tool) is None:
            return f"{tool} is not installed (package {package})"
    tried = subprocess.run([*_unshare(), "true"], capture_output=True, text=True, check=False)  # noqa: S603 - our own words
    return "" if tried.returncode == 0 else f"no namespaces of our own: {tried.stderr.strip()}"


def _unshare() -> list[str]:
    mine = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    return ["unshare", *mine, "--net", "--mount", "--propagation", "private"]


def enter_own_namespaces(arguments: list[str]) -> None:
    """Begin this command anew, with ``arguments`` of Python, in namespaces of its own; returns once it is there."""
    if os.environ.get(INSIDE):
        return
    os.environ[INSIDE] = "1"
    os.execvp("unshare", [*_unshare(), sys.executable, *arguments])  # noqa: S606, S607 - found by why_no_hosts


def run(*command: str) -> str:
    """What a tool of the system says; raises UserError with its own words where it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
    if done.returncode:
        raise UserError(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}")
    return done.stdout


@dataclass
class Host:
    """One namespace, held by a process."""

    name: str
    address: str
    holder: subprocess.Popen[bytes]
    relay: subprocess.Popen[bytes] | None = None  # stands between it and the switch while its link is bad

    @property
    def entering(self) -> list[str]:
        """What a command begins with that runs there."""
        return ["nsenter", f"--net=/proc/{self.holder.pid}/ns/net", "--"]


class Network:
    """The switch, here, and hosts on it; a context manager. This process is a host as well."""

    here = f"{NETWORK}.1"

    def __init__(self) -> None:
        """Not before `enter_own_namespaces`."""
        self.hosts: dict[str, Host] = {}

    def __enter__(self) -> Self:
        run("ip", "link", "set", "lo", "up")
        run("ip", "link", "add", SWITCH, "type", "bridge")
        run("ip", "addr", "add", f"{self.here}/24", "dev", SWITCH)
        run("ip", "link", "set", SWITCH, "up")
        return self

    def __exit__(self, *_: object) -> None:
        for host in self.hosts.values():
            for process in filter(None, (host.relay, host.holder)):
                process.kill()
                process.wait()
        run("ip", "link", "delete", SWITCH)

    def add(self, name: str) -> Host:
        """A new host, linked to all others."""
        holder = _child("unshare", "--net", "sleep", "infinity")
        mine = Path("/proc/self/ns/net").stat().st_ino
        if not wait_until(lambda: Path(f"/proc/{holder.pid}/ns/net").stat().st_ino != mine, 10):
            raise UserError(f"no network namespace for {name}")
        host = Host(name, f"{NETWORK}.{len(self.hosts) + 2}", holder)
        self.hosts[name] = host
        run(*host.entering, "ip", "link", "set", "lo", "up")
        self._wire(host)
        return host

    def cut(self, name: str) -> None:
        """Nothing passes any more; nobody is told."""
        run("ip", "link", "set", port_of(name), "down")

    def mend(self, name: str) -> None:
        """As at first."""
        host = self.hosts[name]
        if host.relay is None:
            run("ip", "link", "set", port_of(name), "up")
            return
        host.relay.kill()  # its two ends go with it
        host.relay.wait()
        host.relay = None
        self._wire(host)

    def worsen(self, name: str, *, delay_ms: float, jitter_ms: float, loss: float) -> None:
        """Every packet to and from the host that much later, or lost; ``loss`` is a share of 1.

        A process of ours passes the packets on: not every kernel has netem.
        """
        host = self.hosts[name]
        run("ip", "link", "delete", port_of(name))
        numbers = [str(delay_ms / 1000), str(jitter_ms / 1000), str(loss)]
        host.relay = _child(sys.executable, "-m", "lab.fault_injection.relay", port_of(name), "far0", *numbers)
        devices = Path("/sys/class/net")
        there = [devices / port_of(name), devices / "far0"]

        def ready() -> bool:
            listed = subprocess.run(["ip", "-br", "link"], capture_output=True, text=True, check=True).stdout  # noqa: S607
            return all(path.name in listed for path in there)

        if not wait_until(ready, 10):
            raise UserError("the bad link did not come up: is /dev/net/tun there?")
        run("ip", "link", "set", port_of(name), "master", SWITCH, "up")
        run("ip", "link", "set", "far0", "netns", str(host.holder.pid), "name", "eth0")
        self._address(host)

    def _wire(self, host: Host) -> None:
        far = ["peer", "name", "eth0", "netns", str(host.holder.pid)]
        run("ip", "link", "add", port_of(host.name), "type", "veth", *far)
        run("ip", "link", "set", port_of(host.name), "master", SWITCH, "up")
        self._address(host)

    def _address(self, host: Host) -> None:
        number = host.address.rsplit(".", 1)[-1]
        # One hardware address whatever the link is made of: nobody has to ask anew who has the address.
        run(*host.entering, "ip", "link", "set", "eth0", "address", f"02:00:00:00:00:{int(number):02x}")
        run(*host.entering, "ip", "addr", "add", f"{host.address}/24", "dev", "eth0")
        run(*host.entering, "ip", "link", "set", "eth0", "up")


def port_of(name: str) -> str:
    """The switch's end of a host's link."""
    return f"to-{name}"[:15]


def _child(*command: str) -> subprocess.Popen[bytes]:
    parent = os.getpid()
    return subprocess.Popen(  # noqa: S603 - our own words
        command, stdin=subprocess.DEVNULL, start_new_session=True,
        preexec_fn=lambda: end_with_parent(parent, signal.SIGKILL),  # noqa: PLW1509 - one call, before any thread of the child
    )  # fmt: skip
