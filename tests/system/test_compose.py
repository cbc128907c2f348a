"""`docker compose up` with a real engine: ends in a robot that has reached its goal, and a recording."""

from __future__ import annotations

import os
import subprocess
import sys
import uuid
from pathlib import Path

import pytest

from services.recorder.reader import read_recording

ROOT = Path(__file__).resolve().parents[2]


def engine() -> bool:
    try:
        return all(
            subprocess.run(["docker", *args], capture_output=True, timeout=30).returncode == 0
            for args in (["info"], ["compose", "version"])
        )
    except (OSError, subprocess.TimeoutExpired):
        return False


@pytest.mark.docker
@pytest.mark.timeout(900)
def test_compose_up_ends_in_a_robot_at_its_goal(tmp_path, free_port):
    if not engine():
        print("\n==== NO DOCKER ENGINE HERE: docker compose was NOT tested ====", file=sys.__stderr__)
        pytest.skip("NO DOCKER ENGINE: docker compose was NOT tested")
    name = f"presage-test-{uuid.uuid4().hex[:8]}"
    environment = {
        **os.environ, "COMPOSE_PROJECT_NAME": name, "PRESAGE_IMAGE": name, "PRESAGE_PORT": str(free_port()),
        "PRESAGE_PAGE_PORT": str(free_port()),
        "PRESAGE_RECORDINGS": str(tmp_path / "recordings"), "COMPOSE_PROGRESS": "plain",
    }  # fmt: skip

    def compose(*args, timeout):
        command = ["docker", "compose", *args]
        return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=timeout)

    try:
        built = compose("build", timeout=600)
        assert built.returncode == 0, built.stdout[-3000:] + built.stderr[-3000:]
        up = compose("up", "--exit-code-from", "goal", timeout=240)
        assert up.returncode == 0, up.stdout[-5000:] + up.stderr[-2000:]
        assert "reached: within 0.2 m of the goal" in up.stdout
        for service in ("simulator", "estimator", "controller", "recorder", "viewer", "router"):
            assert f"{service}-1 exited with code 0" in up.stdout + up.stderr
    finally:
        compose("down", "--volumes", timeout=60)
        subprocess.run(["docker", "image", "rm", "--force", name], capture_output=True, timeout=60)
    (file,) = (tmp_path / "recordings").glob("*.mcap")
    recording = read_recording(file)
    counts = {key.split("/")[-1]: count for key, count in recording.counts().items()}
    assert counts["scan"] > 100
    assert counts["belief"] > 100
    assert recording.world().name == "corridor"
