"""`docker compose` with a real engine: contents of the images, reaching a goal, and replacing running services."""

from __future__ import annotations

import os
import subprocess
import uuid
from itertools import pairwise

import numpy as np
import pytest

from common.bus.bus import Link, open_bus, wait_until
from common.bus.security import read_credentials
from common.messages.definitions import Belief, Map, Scan, Status, Truth
from common.messages.topics import BELIEF, CMD_VEL, MAP, SCAN, STATUS, TRUTH
from presage.live.latest_messages import LatestMessages
from presage.session import credentials as secure
from services.recorder.reader import read_recording
from tests.conftest import free_tcp_port
from tests.system.compose import SERVICES, TIMEOUT_S, Compose, docker, engine, report_skipped

pytestmark = [pytest.mark.docker, pytest.mark.timeout(1500)]
HEAVY = ("pybullet", "torch", "numba", "scipy", "mcap", "starlette", "typer", "matplotlib", "rosbags")
HOLDS = {
    "router": set(), "none": set(), "recorder": {"mcap"}, "replay": {"mcap"}, "controller": {"numba", "scipy"},
    "bridge_ros2": {"rosbags"}, "simulator": {"pybullet", "scipy"}, "estimator-precise": {"numba", "scipy"},
    "estimator-paper": {"torch", "numba", "scipy"},
    "mapper": {"numba", "scipy"},
    "viewer": {"mcap", "starlette", "typer"}, "cli": {"mcap", "typer", "matplotlib"},
}  # fmt: skip


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """Name prefix of the images built for these tests; they are removed afterwards."""
    if not engine():
        pytest.skip(report_skipped())
    tag = f"presage-test-{uuid.uuid4().hex[:8]}"
    builder = Compose(tag, tmp_path_factory.mktemp("build"), (0, 0))
    try:
        # One image after the other: at the same time, engines without BuildKit would install the same packages in each.
        builder.do("build", timeout=1200, COMPOSE_PARALLEL_LIMIT="1")
        for scanner in ("replay", "none", "bridge_ros2"):
            builder.do("build", "simulator", timeout=300, PRESAGE_SCANNER=scanner)
        builder.do("build", "estimator", timeout=900, PRESAGE_ESTIMATOR="paper")
        builder.do("build", "mapper", timeout=300)
        yield tag
    finally:
        docker("image", "rm", "--force", *(f"{tag}-{target}" for target in (*HOLDS, "estimator-particle-filter")))


@pytest.fixture
def compose(image, tmp_path):
    """A function that creates compose projects; all are taken down afterwards."""
    made = []

    def make(**settings):
        made.append(Compose(image, tmp_path / "recordings", (free_tcp_port(), free_tcp_port()), **settings))
        return made[-1]

    yield make
    for each in made:
        each.down()


LIST_PACKAGES = f"""
import importlib, importlib.util, os
found = [name for name in {HEAVY} if importlib.util.find_spec(name)]
for name in found:
    importlib.import_module(name)
print()
print(f"user{{os.getuid()}}", *found)
"""


def test_packages_of_each_image(image):
    how = ("docker", "run", "--rm", "--read-only", "--tmpfs", "/tmp", "--network", "none")
    started = {
        target: subprocess.Popen(
            [*how, f"{image}-{target}", "python", "-c", LIST_PACKAGES], stdout=subprocess.PIPE, text=True
        )
        for target in HOLDS
    }
    for target, running in started.items():
        words = set(running.communicate(timeout=TIMEOUT_S)[0].split())  # pybullet prints more
        assert running.returncode == 0, target
        assert "user1000" in words
        assert words & set(HEAVY) == HOLDS[target], target


def test_up_drives_two_robots_to_the_goal(compose):
    project = compose(ROBOTS="2", GOAL_X="6")
    up = project("up", "--exit-code-from", "goal", timeout=300)
    assert up.returncode == 0, up.stdout[-5000:] + up.stderr[-2000:]
    for robot in ("robot-1", "robot-2"):
        assert f"{robot} | reached: within 0.02 m of the goal" in up.stdout
    for service in (*SERVICES, "viewer"):
        assert f"{service}-1 exited with code 0" in up.stdout + up.stderr
    project.down()
    first, second = project.recordings()
    assert (first.name[:15], second.name[:15]) == ("presage-robot-1", "presage-robot-2")
    recording = read_recording(first)
    counts = {key.split("/")[-1]: count for key, count in recording.counts.items()}
    assert min(counts["scan"], counts["belief"]) > 50
    assert recording.world().name == "corridor"


def test_secure_mode_and_health(compose, tmp_path):
    keys = tmp_path / "keys"
    secure.init(keys)
    both = os.pathsep.join(["docker-compose.yml", "docker-compose.secure.yml"])
    project = compose(COMPOSE_FILE=both, PRESAGE_KEYS=str(keys), PRESAGE_UID=str(os.getuid()), GOAL_X="6")
    project.do("up", "--detach")
    router = (f"tcp/127.0.0.1:{project.router}",)
    with open_bus(Link(connect=router)) as stranger:
        with open_bus(Link(connect=router, security=read_credentials(keys, ("observer",)))) as known:
            messages = LatestMessages(known, TRUTH, STATUS)
            assert messages.wait_for(Truth, lambda truth: truth.pose.x > 5.0, TIMEOUT_S), project.explain("goal")
            assert known.alive() >= {"simulator", "estimator", "controller", "recorder"}
        assert project.ends("goal") == 0
        assert "reached: within 0.02 m of the goal" in project.do("logs", "goal")
        assert not stranger.linked()
    assert "refused" in project.do("logs", "router")

    # A frozen service is unhealthy until it continues, a killed one is restarted by the engine.
    for service in ("router", "simulator", "estimator"):
        project.becomes(service, "healthy")
    send_signal(project, "STOP")
    project.becomes("estimator", "unhealthy")
    assert "no report for" in project.state("estimator")["Health"]["Log"][-1]["Output"]
    assert project.health("simulator") == "healthy"
    send_signal(project, "CONT")
    project.becomes("estimator", "healthy")
    began = project.state("estimator")["StartedAt"]
    send_signal(project, "KILL")
    assert wait_until(lambda: project.state("estimator")["StartedAt"] > began, TIMEOUT_S, 0.5)
    project.becomes("estimator", "healthy")


def send_signal(project, number):
    """Sends a signal to the service itself, because the container's init process does not forward it."""
    find = "for p in /proc/[0-9]*; do [ $p = /proc/1 ] || [ $p = /proc/$$ ] || "
    find += "! grep -qs services.estimator $p/cmdline || "
    project.do("exec", "-T", "estimator", "sh", "-c", f"{find} kill -{number} ${{p#/proc/}}; done")


def gaps(messages):
    """Pairs of sequence numbers between which messages are missing."""
    return [(before.seq, later.seq) for before, later in pairwise(messages) if later.seq != before.seq + 1]


def replacement_beliefs(recording):
    """The last belief of the first estimator and the first one of the second, each with its recorded payload."""
    beliefs = [(message, raw) for _, message, raw in recording.messages(BELIEF)]
    first = [each for each in beliefs if each[0].estimator == beliefs[0][0].estimator]
    second = [each for each in beliefs if each[0].estimator != beliefs[0][0].estimator]
    assert {message.estimator for message, _ in second} == {"particle-filter"}
    assert first[-1][0].stamp_ns < second[0][0].stamp_ns  # the estimators never ran at the same time
    return first[-1], second[0]


def test_replaced_services(compose):
    project = compose(PRESAGE_VIEWER="0", PRESAGE_MAX_SPEED="0.5", GOAL_X="9")
    project.do("up", "--detach")
    assert project.do("ps", "--all", "--quiet", "viewer") == ""
    with open_bus(Link(connect=(f"tcp/127.0.0.1:{project.router}",))) as bus:
        messages = LatestMessages(bus, TRUTH, STATUS, BELIEF, SCAN)
        assert messages.wait_for(Truth, lambda truth: truth.pose.x > 5.0, TIMEOUT_S), project.explain("goal")

        # Replace the estimator while the robot drives: the robot stops, then continues to its goal.
        project.do("stop", "estimator")
        alone = messages.wait_for(Status, lambda status: "no belief for" in status.reason, TIMEOUT_S)
        assert alone is not None
        assert messages.wait_for(Truth, lambda truth: truth.stamp_ns > alone.stamp_ns + 2e9, TIMEOUT_S) is not None
        project.do("up", "--detach", "--no-deps", "estimator", PRESAGE_ESTIMATOR="particle-filter")
        assert project.ends("goal") == 0
        assert "reached: within 0.02 m of the goal" in project.do("logs", "goal")

        # Replace the controller: the robot stops, then accepts the next goal.
        project.do("up", "--detach", "--no-deps", "controller", PRESAGE_MAX_SPEED="0.8")
        project.becomes("controller", "healthy")
        project.do("run", "--rm", "--no-deps", "goal", "presage", "goal", "7", "1.5", "--wait")

        # Replace the simulator by a replay of the recording, with the same estimator and controller.
        project.do("stop", "recorder")
        (file,) = project.recordings()
        project.do("start", "recorder")
        replayed = {"PRESAGE_SCANNER": "replay", "PRESAGE_REPLAY": file.name}
        project.do("up", "--detach", "--no-deps", "simulator", **replayed)
        project.becomes("simulator", "healthy")
        again = messages.wait_for(Scan, lambda scan: scan.seq < 100, TIMEOUT_S)
        assert again is not None
        assert messages.wait_for(Belief, lambda belief: belief.stamp_ns >= again.stamp_ns, TIMEOUT_S) is not None
        assert bus.alive() >= {"replay", "estimator", "controller", "recorder"}
    project.down()

    recording = read_recording(file)
    scans = [message for _, message, _ in recording.messages(SCAN)]
    assert gaps(scans) == []
    (last, last_raw), (first, first_raw) = replacement_beliefs(recording)
    before, after = last.stamp_ns * 1e-9, first.stamp_ns * 1e-9
    moving = [raw.logged_ns for _, command, raw in recording.messages(CMD_VEL) if np.any(command.twist.array())]
    assert moving[0] < last_raw.logged_ns
    assert not [at for at in moving if last_raw.logged_ns + 0.7e9 < at < first_raw.logged_ns]
    assert moving[-1] > first_raw.logged_ns
    truths = [message for _, message, _ in recording.messages(TRUTH)]
    assert gaps(truths) == []
    stands = [each for each in truths if before + 1.5 < each.stamp_ns * 1e-9 <= after]
    assert len(stands) > 5
    assert np.ptp([(each.pose.x, each.pose.y) for each in stands], axis=0).max() < 0.01  # m
    assert max(each.pose.x for each in truths) > 8.9
    assert not any(each.contact for each in truths)
    reasons = [m.reason for _, m, _ in recording.messages(STATUS) if before < m.stamp_ns * 1e-9 + 1 < after + 1]
    assert any("no belief for" in reason for reason in reasons)


def test_mapping(compose):
    """A building that only the simulator knows is mapped; the robot reaches goals meanwhile, and in the saved map."""
    project = compose(PRESAGE_WORLD="office", PRESAGE_HIDE_WORLD="1", PRESAGE_CONTROLLER_ARGS="--world=")
    project.do("up", "--detach", "router", "simulator", "controller", "mapper")
    for service in ("simulator", "controller", "mapper"):
        project.becomes(service, "healthy")
    with open_bus(Link(connect=(f"tcp/127.0.0.1:{project.router}",))) as bus:
        assert LatestMessages(bus, MAP).wait_for(Map, lambda _: True, TIMEOUT_S), project.explain("mapper")
    project.do("run", "--rm", "--no-deps", "goal", "presage", "goal", "2.5", "0", "--wait")
    project.do("run", "--rm", "--no-deps", "goal", "presage", "save-map", "floor")
    assert (project.folder / "floor.yaml").exists()
    project.do("stop", "mapper")
    saved = {"PRESAGE_MAPS": str(project.folder), "PRESAGE_WORLD": "/maps/floor.yaml", "PRESAGE_MODEL": "exact"}
    project.do("up", "--detach", "--no-deps", "estimator", "controller", PRESAGE_CONTROLLER_ARGS="", **saved)
    for service in ("estimator", "controller"):
        project.becomes(service, "healthy")
    project.do("run", "--rm", "--no-deps", "goal", "presage", "goal", "1", "0", "--wait")
    project.down()
