"""Several hosts on one machine, as network namespaces.

All changes are made in namespaces of this process and its children. The rest of the machine is not affected, and
nothing is left when the processes end, however they end.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import Self

from common.bus.bus import wait_until
from common.errors import UserError
from common.processes import end_with_this_process
from presage.interrupts import deferring_interrupts

NAMESPACE_VARIABLE = "PRESAGE_CHAOS_INSIDE"  # set in a process that has its own namespaces
SWITCH = "switch0"
RELAY_DEVICE = "far0"  # the relay's device towards the host, before it is moved there
MAX_DEVICE_NAME = 15  # characters (IFNAMSIZ)
NETWORK = "10.77.0"  # cannot collide with other networks, because the namespaces are private


def namespaces_unavailable_reason() -> str:
    """Returns why this process cannot create network namespaces; an empty string if it can."""
    for tool, package in (("unshare", "util-linux"), ("nsenter", "util-linux"), ("ip", "iproute2")):
        if shutil.which(tool) is None:
            return f"{tool} is not installed (package {package})"
    attempt = subprocess.run([*_unshare(), "true"], capture_output=True, text=True, check=False)  # noqa: S603 - fixed commands
    return "" if attempt.returncode == 0 else f"network namespaces are not permitted: {attempt.stderr.strip()}"


def _unshare() -> list[str]:
    user_namespace = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    return ["unshare", *user_namespace, "--net", "--mount", "--propagation", "private"]


def enter_own_namespaces(arguments: list[str]) -> None:
    """Replaces this process by Python with ``arguments`` in new namespaces. Returns if it already has its own."""
    if os.environ.get(NAMESPACE_VARIABLE):
        return
    os.environ[NAMESPACE_VARIABLE] = "1"
    os.execvp("unshare", [*_unshare(), sys.executable, *arguments])  # noqa: S606, S607 - found by namespaces_unavailable_reason


def run(*command: str) -> str:
    """Runs a system tool. Returns its output; raises UserError with its error message if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - fixed commands
    if done.returncode:
        raise UserError(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}")
    return done.stdout


@dataclass
class Host:
    """A network namespace, kept open by a process."""

    name: str
    address: str
    holder: subprocess.Popen[bytes]
    relay: subprocess.Popen[bytes] | None = None  # between the host and the switch while its link is degraded

    @property
    def command_prefix(self) -> list[str]:
        """The words before a command that make it run on this host."""
        return ["nsenter", f"--net=/proc/{self.holder.pid}/ns/net", "--"]


class Network:
    """A switch and the hosts connected to it; a context manager. This process is on a host of its own."""

    own_address = f"{NETWORK}.1"

    def __init__(self) -> None:
        """Call `enter_own_namespaces` first."""
        self.hosts: dict[str, Host] = {}

    def __enter__(self) -> Self:
        run("ip", "link", "set", "lo", "up")
        run("ip", "link", "add", SWITCH, "type", "bridge")
        run("ip", "addr", "add", f"{self.own_address}/24", "dev", SWITCH)
        run("ip", "link", "set", SWITCH, "up")
        return self

    def __exit__(self, *_: object) -> None:
        for host in self.hosts.values():
            for process in filter(None, (host.relay, host.holder)):
                process.kill()
                process.wait()
        run("ip", "link", "delete", SWITCH)

    def add(self, name: str) -> Host:
        """Creates a host that is connected to all others."""
        holder = _child("unshare", "--net", "sleep", "infinity")
        own = Path("/proc/self/ns/net").stat().st_ino
        if not wait_until(lambda: Path(f"/proc/{holder.pid}/ns/net").stat().st_ino != own, 10):
            raise UserError(f"could not create a network namespace for host {name} within 10 s")
        host = Host(name, f"{NETWORK}.{len(self.hosts) + 2}", holder)
        self.hosts[name] = host
        run(*host.command_prefix, "ip", "link", "set", "lo", "up")
        self._connect(host)
        return host

    def cut(self, name: str) -> None:
        """Cuts the host's link: packets are lost, and connections are not closed."""
        run("ip", "link", "set", port_of(name), "down")

    def restore(self, name: str) -> None:
        """Restores the host's link to its original state."""
        host = self.hosts[name]
        if host.relay is None:
            run("ip", "link", "set", port_of(name), "up")
            return
        host.relay.kill()  # its two network devices disappear with it
        host.relay.wait()
        host.relay = None
        self._connect(host)

    def degrade(self, name: str, *, delay_ms: float, jitter_ms: float, loss: float) -> None:
        """Delays the packets to and from the host, and drops a share ``loss`` (0 to 1) of them.

        A relay process passes the packets on, because not every kernel has netem.
        """
        host, port = self.hosts[name], port_of(name)
        run("ip", "link", "delete", port)
        numbers = [str(delay_ms / 1000), str(jitter_ms / 1000), str(loss)]
        host.relay = _child(sys.executable, "-m", "lab.fault_injection.relay", port, RELAY_DEVICE, *numbers)
        if not wait_until(lambda: {port, RELAY_DEVICE} <= {device for _, device in socket.if_nameindex()}, 10):
            raise UserError("the relay created no network devices within 10 s: does /dev/net/tun exist?")
        run("ip", "link", "set", port, "master", SWITCH, "up")
        run("ip", "link", "set", RELAY_DEVICE, "netns", str(host.holder.pid), "name", "eth0")
        self._configure(host)

    def _connect(self, host: Host) -> None:
        """Connects the host to the switch by a pair of virtual network devices."""
        host_end = ["peer", "name", "eth0", "netns", str(host.holder.pid)]
        run("ip", "link", "add", port_of(host.name), "type", "veth", *host_end)
        run("ip", "link", "set", port_of(host.name), "master", SWITCH, "up")
        self._configure(host)

    def _configure(self, host: Host) -> None:
        """Sets the addresses of the host's network device, and switches it on."""
        number = host.address.rsplit(".", 1)[-1]
        # The hardware address stays the same when the link is replaced, so that other hosts' ARP entries stay valid.
        run(*host.command_prefix, "ip", "link", "set", "eth0", "address", f"02:00:00:00:00:{int(number):02x}")
        run(*host.command_prefix, "ip", "addr", "add", f"{host.address}/24", "dev", "eth0")
        run(*host.command_prefix, "ip", "link", "set", "eth0", "up")


def port_of(name: str) -> str:
    """Network device at the switch's end of a host's link."""
    return f"to-{name}"[:MAX_DEVICE_NAME]


def _child(*command: str) -> subprocess.Popen[bytes]:
    """Starts a process that ends with this one."""
    with deferring_interrupts():
        return subprocess.Popen(  # noqa: S603 - fixed commands
            command,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=end_with_this_process(signal.SIGKILL),  # noqa: PLW1509 - one call, before any thread of the child
        )
