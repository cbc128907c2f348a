"""A viewer opens a recording: its replay in a process of its own, for the visitor who asked for it."""

from __future__ import annotations

import signal

import psutil
import pytest

from common.bus.bus import wait_until
from tests.conftest import ended
from tests.recorder import sessions as recorded
from tests.viewer.client import Page, is_complete, page_of


@pytest.fixture
def viewer(process, tmp_path):
    (tmp_path / "broken.mcap").write_bytes(b"no recording at all, but long enough to be looked at twice")
    recorded.write(tmp_path / "hall.mcap")  # 10 s, 10 scans a second
    return process("viewer", "--port", "0", "--recordings", str(tmp_path))


def test_recording_of_one_visitor(viewer, bus):
    ghost = f"{bus.robot}-replay"
    where = page_of(viewer)
    with Page(where) as page, Page(where) as other:
        rows = {row["name"]: row for row in page.done("recordings")["files"]}
        assert set(rows) == {"broken.mcap", "hall.mcap"}
        assert "duration" not in rows["broken.mcap"]
        assert rows["hall.mcap"]["duration"] == pytest.approx(9.9, abs=0.1)
        assert not page.request("player", action="resume")["ok"]
        assert not page.request("open", name="../hall.mcap")["ok"]
        assert "not an MCAP file" in page.request("open", name="broken.mcap")["reason"]

        page.done("open", name="hall.mcap")
        hello = page.last["hello"]
        assert (hello["robot"], ghost in hello["robots"]) == (ghost, True)
        assert page.by_now("world", lambda m: m["world"])["world"]["name"] == "hall"
        frame = page.by_now("frame", lambda f: f.header["robot"] == ghost and is_complete(f.header))
        assert frame.header["error"] == pytest.approx(2.0)
        assert len(frame.arrays["ranges"]) == len(frame.arrays["predicted"]) == recorded.SCANNER.beams
        state = page.wait_for("player")
        assert (state["paused"], state["file"]) == (True, "hall.mcap")
        other.by_now("hello", lambda m: ghost in m["robots"] and m["robot"] == bus.robot)  # keeps its robot
        assert "recording" in page.request("goal", x=5, y=1.5)["reason"]

        page.done("player", action="seek", value=5.0)
        page.frame(lambda h: h["t"] == pytest.approx(5.0, abs=0.11) and is_complete(h))
        begin = page.last["frame"].header["t"]
        page.done("player", action="step")
        assert page.frame(lambda h: h["t"] > begin).header["t"] == pytest.approx(begin + 0.1)
        page.done("player", action="seek", value=0.5)
        page.frame(lambda h: h["t"] < 1.0)
        page.done("player", action="rate", value=8)
        page.done("player", action="resume")
        page.wait_for("player", lambda m: m["paused"] and m["position_s"] == pytest.approx(m["duration_s"]))  # it stays
        page.done("player", action="rate", value=0.5)  # faster, a slow machine may skip the first second
        page.done("player", action="resume")  # it starts from the beginning
        page.frame(lambda h: h["t"] < 1.0)

        page.done("close")
        assert "closed" in page.last
        page.by_now("hello", lambda m: m["robots"] == [bus.robot])


def test_death_of_replay_and_viewer(viewer, bus):
    def open_recording(page):
        page.done("open", name="hall.mcap")
        (child,) = psutil.Process(viewer.child.pid).children()
        return child

    with Page(page_of(viewer)) as page:
        open_recording(page).kill()
        page.wait_for("closed")
        page.by_now("hello", lambda m: m["robots"] == [bus.robot])
        child = open_recording(page)
        viewer.send(signal.SIGKILL)
        assert wait_until(lambda: ended(child), 20)
