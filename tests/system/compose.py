"""`docker compose` for tests, with a separate image tag, and a separate project, ports and recordings for each test."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import uuid
from pathlib import Path

from common.bus.bus import wait_until

ROOT = Path(__file__).resolve().parents[2]
SERVICES = ("router", "simulator", "estimator", "controller", "recorder")  # started by default
TIMEOUT_S = 120.0  # for events that take some ten seconds on an idle machine


def docker(*args, timeout=60):
    return subprocess.run(["docker", *args], capture_output=True, text=True, timeout=timeout)


def engine() -> bool:
    try:
        return all(docker(*args, timeout=30).returncode == 0 for args in (["info"], ["compose", "version"]))
    except (OSError, subprocess.TimeoutExpired):
        return False


def report_skipped() -> str:
    print("\n==== NO DOCKER ENGINE HERE: docker compose was NOT tested ====", file=sys.__stderr__)
    return "NO DOCKER ENGINE: docker compose was NOT tested"


class Compose:
    """A compose project; its settings are environment variables, as a user would set them."""

    def __init__(self, image: str, folder: Path, ports: tuple[int, int], **settings: str) -> None:
        self.name, self.folder, self.router = f"presage-test-{uuid.uuid4().hex[:8]}", folder, ports[0]
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o777)  # for the images' own user
        clean = {k: v for k, v in os.environ.items() if not k.startswith("PRESAGE_") and k != "ROBOTS"}
        self.environment = {
            **clean, "COMPOSE_PROJECT_NAME": self.name, "PRESAGE_IMAGE": image, "COMPOSE_PROGRESS": "plain",
            "PRESAGE_PORT": str(ports[0]), "PRESAGE_PAGE_PORT": str(ports[1]), "PRESAGE_RECORDINGS": str(folder),
            **settings,
        }  # fmt: skip

    def __call__(self, *args, timeout=TIMEOUT_S, **settings):
        """Runs `docker compose ARGS`; it may fail."""
        command, environment = ["docker", "compose", *args], {**self.environment, **settings}
        return subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=timeout, check=False
        )

    def do(self, *args, timeout=TIMEOUT_S, **settings) -> str:
        """Runs `docker compose ARGS`, which must not fail. Returns its output."""
        done = self(*args, timeout=timeout, **settings)
        assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
        return done.stdout

    def state(self, service: str) -> dict:
        """State of the service's container."""
        labels = (f"project={self.name}", f"service={service}", "oneoff=False")
        filters = (word for label in labels for word in ("--filter", f"label=com.docker.compose.{label}"))
        # Takes a sixth of the time of `docker compose ps`.
        (row,) = docker("ps", "--all", "--quiet", *filters).stdout.split()
        return json.loads(docker("inspect", row).stdout)[0]["State"]

    def health(self, service: str) -> str:
        return self.state(service)["Health"]["Status"]

    def becomes(self, service: str, health: str, timeout=TIMEOUT_S) -> None:
        """Waits until the container has the given health status."""
        assert wait_until(lambda: self.health(service) == health, timeout, 0.5), self.explain(service)

    def ends(self, service: str, timeout=TIMEOUT_S) -> int:
        """Waits until the container has ended. Returns its exit status."""
        over = lambda: self.state(service)["Status"] == "exited"  # noqa: E731
        assert wait_until(over, timeout, 0.5), self.explain(service)
        return self.state(service)["ExitCode"]

    def explain(self, service: str) -> str:
        log = self("logs", "--no-color", "--tail", "40").stdout
        return f"{service}: {json.dumps(self.state(service))[:3000]}\n{log}"

    def recordings(self) -> list[Path]:
        """Complete recordings, the oldest first."""
        return sorted(self.folder.glob("*.mcap"))

    def down(self) -> str:
        """Removes everything, the services of profiles too, which `down` alone leaves running."""
        return self("--profile", "*", "down", "--volumes", "--remove-orphans", timeout=90).stderr
