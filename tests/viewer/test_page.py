"""The page in a real browser, before the real system: simulator, estimator, controller, recorder, viewer."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest

from common.messages.topics import SCAN
from services.recorder.reader import read_recording
from tests.conftest import ROOT, WAIT_TIMEOUT_S
from tests.viewer.client import Page
from tests.viewer.live_system import SEEN, System

STATIC = ROOT / "services" / "viewer" / "static"
COLOURS = """(() => {
    const canvas = document.getElementById("c-scan");
    return new Set(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data).size;
})()"""


@pytest.fixture(scope="module")
def system(module_processes):
    return System(module_processes)


def test_sources():
    """No text is ever read as HTML, and the page needs no other host and no inline code."""
    code = {path.name: path.read_text() for path in (STATIC / "js").glob("*.js")}
    assert len(code) > 10
    forbidden = re.compile(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|srcdoc")
    assert {name: found for name, text in code.items() if (found := forbidden.findall(text))} == {}
    text = (STATIC / "index.html").read_text() + "".join(path.read_text() for path in STATIC.rglob("*.css"))
    assert not re.search(r"https?://|\bstyle=|\bon[a-z]+=|<style|@import", text)
    assert re.findall(r"<script[^>]*>", text) == [
        '<script src="js/reload.js">',
        '<script type="module" src="js/main.js">',
    ]


def test_frames(page):
    page.see(SEEN)
    page.wait("window.seen.length > 60")
    stamps, _, _ = np.array(page.see("window.seen.slice(0, 60)")).T
    steps = np.diff(stamps) * 15  # scans from frame to frame, however fast this machine lets them come
    assert np.abs(steps - np.round(steps)).max() < 0.01
    assert steps.min() > 0.5  # each once, in order
    assert 1 in np.round(steps), "frames are left out"  # some may be, on a busy machine
    came, rate = page.see("[window.seen.map((one) => one[1]).filter((at) => at >= store.arrivals[0]), "
                          "store.rate(store.arrivals.at(-1))]")  # fmt: skip
    assert rate == pytest.approx(1000 * (len(came) - 1) / (came[-1] - came[0]), rel=0.1)
    page.wait("store.frame.ranges.length > 500 && store.frame.ranges.length === store.frame.predicted.length")
    page.wait("document.querySelector('#estimator-badge b').innerText === 'tracking'")
    page.wait("document.querySelectorAll('#services tr').length >= 5")
    page.wait(f"{COLOURS} > 20")  # more than an empty canvas has


def test_obstacles_and_keys(page):
    page.page.keyboard.press("o")
    page.click(9.0, 3.0)
    page.toast("added")
    page.wait("store.world.obstacles.some((o) => o.name === 'box-1')")
    page.drag((9.0, 3.0), (9.0, 2.2))
    page.wait("Math.abs(store.world.obstacles.find((o) => o.name === 'box-1').box.center[1] - 2.2) < 0.1")
    page.page.get_by_role("button", name="Remove").click()
    page.wait("!store.world.obstacles.some((o) => o.name === 'box-1')")

    page.page.locator("#map").focus()
    page.page.keyboard.press("x")
    yaw = page.see("store.frame.truth.yaw")
    page.page.keyboard.down("a")
    page.wait("store.frame.status.state === 'manual'")
    page.wait("Math.abs(Math.sin((store.frame.truth.yaw - arg) / 2)) > 0.1", argument=yaw)
    page.page.keyboard.up("a")
    page.wait("store.frame.status.state !== 'manual'")
    page.page.keyboard.down("a")
    page.wait("store.frame.status.state === 'manual'")
    page.page.keyboard.down("Meta")  # while it is held, macOS does not report that "a" is released
    page.wait("store.frame.status.state !== 'manual'")
    page.page.keyboard.up("a")
    page.page.keyboard.up("Meta")
    page.page.keyboard.press(" ")
    page.wait("store.paused")
    page.wait("performance.now() - store.arrivals.at(-1) > 500")
    stood = page.see("store.frame.stamp_ns")
    page.page.keyboard.press(".")
    page.wait("store.frame.stamp_ns > arg", argument=stood)
    assert page.see("store.frame.stamp_ns") - stood < 0.1e9
    page.page.keyboard.press(" ")
    page.wait("store.frame.stamp_ns > arg + 5e8", argument=stood)


def test_recording(page, system):
    page.page.locator("#record").click()
    page.wait("document.getElementById('record').getAttribute('aria-pressed') === 'true'")
    page.wait("store.frame.t > arg + 2", argument=page.see("store.frame.t"))
    page.page.locator("#record").click()
    page.wait("document.getElementById('record').getAttribute('aria-pressed') === 'false'")
    (name,) = [path.name for path in system.folder.glob("*.mcap")]
    # Not from the live page, which on a busy machine shows scans that are older than the recording.
    stamps = [scan.stamp_ns for _, scan, _ in read_recording(system.folder / name).messages(SCAN)]
    middle = (stamps[0] + stamps[-1]) / 2e9
    page.page.locator("#open").click()
    page.page.locator(f'[data-file="{name}"]').click()
    page.wait("store.player && store.frame && store.world")
    length = page.see("store.player.duration_s")
    assert length > 1.5
    assert page.see("store.player.paused")
    page.page.locator("#player-play").click()
    page.wait("store.player.paused && store.player.position_s > arg - 0.1", argument=length)  # pauses at the end
    for share, side in ((0.1, "<"), (0.9, ">"), (0.2, "<")):
        page.page.locator("#player-seek").fill(str(round(share * length, 2)))
        page.wait("Math.abs(store.player.position_s - arg) < 0.5", argument=share * length)
        page.wait(f"store.frame.t {side} arg", argument=middle)
    page.page.locator("#player-close").click()
    page.wait("!store.player && store.frame?.robot === 'robot'")


def test_missing_service(page, system):
    system.running["controller"].stop()
    notice = page.page.locator(".notice", has_text="controller is missing")
    notice.wait_for(timeout=1000 * WAIT_TIMEOUT_S)
    assert "python -m services.controller" in notice.locator("code").inner_text()
    page.page.locator("#controller-badge b", has_text="missing").wait_for(timeout=1000 * WAIT_TIMEOUT_S)
    page.wait("store.frame.status === null")
    system.start("controller")
    notice.wait_for(state="detached", timeout=1000 * WAIT_TIMEOUT_S)
    page.wait("store.frame?.status?.state === 'idle'")


def test_two_visitors(system):
    """Without a browser: what both see, and what the page's buttons do not reach."""
    with Page(system.address) as page, Page(system.address) as other:
        # On a busy machine, the belief may always be that of an earlier scan.
        frame = page.frame(lambda h: h["latency_ms"] is not None and h["arrays"]["predicted"][1] > 0)
        assert len(frame.arrays["ranges"]) == len(frame.arrays["predicted"]) == len(frame.arrays["sigma"])
        assert frame.header["latency_ms"] > 0
        far = 4.5 if frame.header["truth"]["x"] > 9 else 13.0  # from the robot, in the free middle of the corridor
        crate = {"box": {"center": [far, 1.5], "size": [0.4, 0.4]}}
        page.done("obstacle", action="add", name="crate", obstacle=crate)
        for visitor in (page, other):
            visitor.wait_for("world", lambda m: "crate" in [o["name"] for o in m["world"]["obstacles"]])
        page.done("obstacle", action="remove", name="crate")
        assert "crate" in page.request("obstacle", action="remove", name="crate")["reason"]
        assert "inside something" in page.request("goal", x=-4, y=1.5)["reason"]
        assert "wall" in page.request("teleport", x=0.05, y=0.05)["reason"]
        page.done("goal", x=far, y=1.5, yaw=1.57)
        frame = page.frame(
            lambda h: (
                h["status"]
                and h["status"]["state"] == "navigating"
                and h["arrays"]["path"][1] > 4
                and h["arrays"]["motion"][1] > 2
            )
        )
        np.testing.assert_allclose(frame.arrays["path"][-2:], [far, 1.5], atol=0.1)
        assert frame.header["status"]["goal"]["yaw_tolerance"] == 0.15
        field = page.by_now("field", lambda f: f.header["goal"]["x"] == far)
        assert np.isfinite(field.arrays["distance"]).sum() > 1000
        page.done("cancel")
        page.frame(lambda h: h["status"]["goal"] is None)
        page.done("localise")

        assert not page.request("step")["ok"]  # refused while the simulation runs
        page.done("pause")
        time.sleep(0.2)  # for frames that are under way
        with Page(system.address) as late:  # gets the current frame
            first = late.frame().header["stamp_ns"]
            page.done("step")
            stepped = late.frame(lambda h: h["stamp_ns"] > first).header
            assert stepped["stamp_ns"] - first == pytest.approx(1e9 / 15, rel=0.01)
        page.done("resume")
        page.done("speed", factor=2)
        assert not page.request("speed", factor=500)["ok"]
        page.done("speed", factor=1)
        page.done("reset", seed=5)
        page.frame(lambda h: h["t"] < stepped["t"])
        page.by_now("history", lambda m: max(m["samples"]["t"], default=0) < stepped["t"])
