"""All actions of the live page against a whole running system, and playback of a recording."""

from __future__ import annotations

import signal
import time

import numpy as np
import psutil
import pytest

from common.bus.bus import Link, open_bus, wait_until
from tests.conftest import Processes
from tests.recorder import sessions as recorded
from tests.viewer.client import Page, page_of

BOX = {"box": {"center": [6.0, 1.5], "size": [0.4, 0.4]}}


ROBOT = "played"


class System:
    """All services but the viewer, shared by the tests."""

    def __init__(self, folder):
        self.processes, self.folder = Processes(folder), folder / "recordings"
        self.folder.mkdir()
        _, port = self.processes.start_router()
        self.connect = f"tcp/127.0.0.1:{port}"
        self.start("recorder", "--idle", "--directory", str(self.folder))
        self.start("simulator", "--beams", "622", "--seed", "1")
        self.start("controller")
        self.start("estimator", "--initial-pose", "3,1.5,90")

    def start(self, name, *args):
        return self.processes.start(name, *args, env={"PRESAGE_CONNECT": self.connect, "PRESAGE_ROBOT": ROBOT})

    def start_viewer(self):
        running = self.start("viewer", "--port", "0", "--recordings", str(self.folder))
        return page_of(running), running


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    made = System(tmp_path_factory.mktemp("system"))
    try:
        with open_bus(Link(ROBOT, (made.connect,))) as bus:
            assert wait_until(lambda: {"simulator", "estimator", "controller", "recorder"} <= bus.alive(), 60)
        yield made
    finally:
        made.processes.close()


@pytest.fixture(scope="module")
def where(system):
    """The address of a viewer's page."""
    return system.start_viewer()[0]


def there(x, y, off=0.3):
    return lambda header: header["truth"] and np.hypot(header["truth"]["x"] - x, header["truth"]["y"] - y) < off


def state_of(header):
    return header["status"] and header["status"]["state"]


def test_goals_teleports_and_localisation_from_the_page(where):
    with Page(where) as page:
        assert page.told("world")["world"]["name"] == "corridor"
        frame = page.frame(lambda h: h["belief"] and h["belief"]["state"] == "tracking" and h["error"] is not None)
        assert len(frame.arrays["ranges"]) == len(frame.arrays["predicted"]) == len(frame.arrays["sigma"]) == 622
        assert frame.header["error"] < 0.2
        assert frame.header["latency_ms"] > 0
        services = page.told("services", lambda m: sum(row["alive"] for row in m["services"]) == 5)
        assert services["missing"] == []

        page.done("goal", x=5.0, y=1.5)
        page.frame(lambda h: state_of(h) == "reached" and there(5.0, 1.5)(h))
        for x, y, why in ((0.05, 1.5, "from a wall"), (-4.0, 1.5, "inside something")):
            answer = page.ask("goal", x=x, y=y)
            assert not answer["ok"]
            assert why in answer["reason"]
            assert "nearest place that can be reached is (" in answer["reason"]
        page.done("goal", x=12.0, y=1.5, yaw=1.57)
        frame = page.frame(lambda h: state_of(h) == "navigating" and h["arrays"]["path"][1] > 4)
        np.testing.assert_allclose(frame.arrays["path"][-2:], [12.0, 1.5], atol=0.1)
        assert frame.header["status"]["goal"]["yaw_tolerance"] == 0.15
        assert len(frame.arrays["motion"]) > 2
        field = page.by_now("field", lambda f: f.header["goal"]["x"] == 12.0)
        assert np.isfinite(field.arrays["distance"]).sum() > 1000
        page.done("cancel")
        page.frame(lambda h: h["status"] and h["status"]["goal"] is None)

        page.done("teleport", x=9.0, y=1.5, yaw=1.57)  # after a kidnapping it localises again
        page.frame(there(9.0, 1.5))
        page.frame(lambda h: h["error"] is not None and h["error"] < 0.1 and there(9.0, 1.5)(h))
        answer = page.ask("teleport", x=0.05, y=0.05)
        assert not answer["ok"]
        assert "wall" in answer["reason"]
        page.done("localise")
        page.frame(lambda h: h["error"] is not None and h["error"] < 0.1)
        page.done("localise", x=9.0, y=1.5, yaw=1.57)


def test_obstacles_and_simulation_time_from_the_page(where):
    with Page(where) as page, Page(where) as other:
        page.told("world")
        other.told("world")
        page.done("obstacle", action="add", name="crate", obstacle=BOX)
        for visitor in (page, other):  # a second browser also gets the change
            world = visitor.told("world")["world"]
            assert "crate" in [o["name"] for o in world["obstacles"]]
        page.done("obstacle", action="move", name="crate", obstacle={"box": {"center": [7, 1.5], "size": [0.4, 0.4]}})
        page.told("world", lambda m: [7.0, 1.5] in [o["box"]["center"] for o in m["world"]["obstacles"] if o["box"]])
        page.done("obstacle", action="remove", name="crate")
        page.told("world", lambda m: "crate" not in [o["name"] for o in m["world"]["obstacles"]])
        answer = page.ask("obstacle", action="remove", name="crate")
        assert not answer["ok"]
        assert "crate" in answer["reason"]

        assert not page.ask("step")["ok"]  # refused while the simulation runs
        page.done("pause")
        time.sleep(0.2)  # for frames that are under way
        with Page(where) as late:  # a browser that connects now gets the current frame
            first = late.frame().header["stamp_ns"]
            page.done("step")
            stepped = late.frame(lambda h: h["stamp_ns"] > first).header
            assert stepped["stamp_ns"] - first == pytest.approx(1e9 / 15, rel=0.01)
            assert stepped["belief"]["stamp_ns"] == stepped["stamp_ns"]
        page.done("resume")
        page.frame(lambda h: h["stamp_ns"] > stepped["stamp_ns"] + 5e8)
        page.done("speed", factor=2)
        assert not page.ask("speed", factor=500)["ok"]
        page.done("speed", factor=1)
        page.done("reset", seed=5)
        page.frame(lambda h: h["t"] < stepped["t"])
        assert max(page.last["history"]["samples"]["t"], default=0) < stepped["t"]


def test_manual_driving_from_the_page(where):
    with Page(where) as page:
        page.done("cancel")
        before = page.frame(lambda h: h["truth"] and h["belief"]).header["truth"]
        deadline = time.monotonic() + 30
        moved = 0.0
        while moved < 0.3 and time.monotonic() < deadline:
            page.done("drive", vx=0.4, vy=0, wz=0)
            now = page.frame().header
            moved = np.hypot(now["truth"]["x"] - before["x"], now["truth"]["y"] - before["y"])
        assert moved >= 0.3
        assert page.frame(lambda h: state_of(h) == "manual")
        page.done("drive", vx=0, vy=0, wz=0)
        page.frame(lambda h: state_of(h) == "idle" and h["cmd"] == {"vx": 0.0, "vy": 0.0, "wz": 0.0})


def record(page):
    """Records two seconds from the page. Returns the file's row in the list of recordings."""
    page.frame(lambda h: h["belief"])
    assert page.done("recordings")["files"] == []
    started = page.done("record", action="start")
    assert started["recording"] is True
    assert not page.ask("record", action="start")["ok"]
    begin = page.frame().header["t"]
    page.frame(lambda h: h["t"] > begin + 2.0)
    stopped = page.done("record", action="stop")
    assert stopped["recording"] is False
    (file,) = page.done("recordings")["files"]
    assert file["name"] == stopped["file"].rsplit("/", 1)[-1]
    assert file["duration"] > 1.5
    return file


def test_a_recording_is_made_opened_and_played_from_the_page(system):
    where, running = system.start_viewer()
    ghost = f"{ROBOT}-replay"
    with Page(where) as page, Page(where) as other:
        file = record(page)
        assert not page.ask("player", action="resume")["ok"]
        assert not page.ask("open", name="../" + file["name"])["ok"]
        page.done("open", name=file["name"])
        hello = page.last["hello"]
        assert (hello["robot"], ghost in hello["robots"]) == (ghost, True)
        first = page.by_now("frame", lambda f: f.header["robot"] == ghost).header
        state = page.told("player")
        assert (state["paused"], state["file"]) == (True, file["name"])
        assert state["duration_s"] == pytest.approx(file["duration"], abs=0.01)
        assert page.last["world"]["world"]["name"] == "corridor"
        assert page.last["world"]["scanner"]["beams"] == 622
        other.by_now("hello", lambda m: ghost in m["robots"] and m["robot"] == ROBOT)
        assert other.frame().header["robot"] == ROBOT  # the other browser keeps its robot

        page.done("player", action="seek", value=1.5)
        # Under load a frame may be sent before all its messages have arrived, and then again.
        whole = lambda h: h["belief"] and h["belief"]["stamp_ns"] == h["stamp_ns"]  # noqa: E731
        frame = page.frame(lambda h: h["stamp_ns"] > first["stamp_ns"] + 1e9 and whole(h)).header
        page.done("player", action="step")
        assert page.frame(lambda h: h["stamp_ns"] > frame["stamp_ns"]).header["stamp_ns"] < frame["stamp_ns"] + 2e8
        page.done("player", action="seek", value=0.5)
        back = page.frame(lambda h: h["stamp_ns"] < frame["stamp_ns"] - 5e8).header
        page.done("player", action="rate", value=4)
        page.done("player", action="resume")
        page.frame(lambda h: h["stamp_ns"] > back["stamp_ns"] + 1e9)
        page.told("player", lambda m: m["paused"] and m["position_s"] == pytest.approx(m["duration_s"]))  # it stays
        page.done("player", action="resume")  # and starts from the beginning
        page.frame(lambda h: h["stamp_ns"] < first["stamp_ns"] + 5e8)
        answer = page.ask("goal", x=5, y=1.5)
        assert not answer["ok"]
        assert "recording" in answer["reason"]

        page.done("close")
        assert "closed" in page.last
        page.frame(lambda h: h["robot"] == ROBOT)
        page.by_now("hello", lambda m: m["robots"] == [ROBOT])
        page.done("open", name=file["name"])
        (child,) = psutil.Process(running.child.pid).children()
        assert running.stop()[0] == 0, running.output
        assert wait_until(lambda: not child.is_running(), 10)


def test_an_invalid_recording_is_refused_and_a_dead_replay_is_reported(process, bus, tmp_path):
    (tmp_path / "broken.mcap").write_bytes(b"no recording at all, but long enough to be looked at twice")
    recorded.write(tmp_path / "hall.mcap")
    running = process("viewer", "--port", "0", "--recordings", str(tmp_path))
    with Page(page_of(running)) as page:
        rows = {row["name"]: row for row in page.done("recordings")["files"]}
        assert set(rows) == {"broken.mcap", "hall.mcap"}
        assert "duration" not in rows["broken.mcap"]
        answer = page.ask("open", name="broken.mcap")
        assert not answer["ok"]
        assert "not an MCAP file" in answer["reason"]
        page.done("open", name="hall.mcap")
        assert page.by_now("world", lambda m: m["world"])["world"]["name"] == "hall"
        frame = page.by_now("frame", lambda f: f.header["robot"] == f"{bus.robot}-replay")
        assert frame.header["error"] == pytest.approx(2.0)
        assert len(frame.arrays["ranges"]) == len(frame.arrays["predicted"]) == 91
        (child,) = psutil.Process(running.child.pid).children()
        child.kill()
        page.told("closed")
        page.by_now("hello", lambda m: m["robots"] == [bus.robot])
        page.done("open", name="hall.mcap")
        (child,) = psutil.Process(running.child.pid).children()
        running.send(signal.SIGKILL)  # nothing outlives the viewer
        assert wait_until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE, 20)
