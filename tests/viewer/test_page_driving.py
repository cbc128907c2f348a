"""Driving from the page in a real browser, in lockstep, so that the robot is localised also on a busy machine."""

from __future__ import annotations

import pytest

from tests.conftest import WAIT_TIMEOUT_S
from tests.viewer.live_system import SEEN, System

AWAY = "Math.hypot({0}.x - arg[0], {0}.y - arg[1])"  # m from a given place


@pytest.fixture(scope="module")
def system(module_processes):
    return System(module_processes, pace="lockstep")


def test_goals(page):
    page.page.keyboard.press("g")
    page.click(9.0, 0.05)
    assert "wall" in page.toast(ok=False)
    x, y = page.see("[store.frame.truth.x, store.frame.truth.y]")
    goal = (x + (1.5 if x < 9 else -1.5), y)
    page.click(*goal)
    assert page.toast().startswith("Going to (")
    page.wait(f"store.frame.status?.goal && {AWAY.format('store.frame.status.goal')} < 0.1", argument=goal)
    page.wait("store.frame.status.state === 'reached'")
    page.wait(f"{AWAY.format('store.frame.truth')} < 0.35", argument=goal)


def test_kidnapping(page):
    x = page.see("store.frame.truth.x")
    there = (13.0, 1.2) if x < 9 else (5.0, 1.2)
    page.wait("store.frame.error < 0.1")
    page.see(SEEN)
    page.page.mouse.move(*page.at(*there))
    page.page.keyboard.down("Shift")
    page.click(*there)
    page.page.keyboard.up("Shift")
    page.toast("Carried")
    page.page.locator("#journal b", has_text="carried").first.wait_for(timeout=1000 * WAIT_TIMEOUT_S)
    found = f"store.frame.belief?.state === 'tracking' && {AWAY.format('store.frame.belief')} < 0.6"
    page.wait(f"{found} && store.frame.error < 0.1", argument=there)
    off = [error for _, _, error in page.see("window.seen") if error >= 0]
    assert off[0] < 0.1  # it was localised,
    assert max(off) > 3  # then metres off on the map,
    assert off[-1] < 0.1  # and localised again
