"""The page while an unknown building is mapped, and after it: the growing map, saving it, the next session."""

from __future__ import annotations

from pathlib import Path

from common.geometry.world import load_world
from tests.conftest import WAIT_TIMEOUT_S
from tests.viewer.client import page_of


def start_mapping(processes):
    """Starts all services of `presage up --world office --mapping`. Returns the viewer and its environment."""
    _, port = processes.start_router()
    environment = {"PRESAGE_CONNECT": f"tcp/127.0.0.1:{port}", "PRESAGE_ROBOT": "robot"}
    processes.start("simulator", "--world", "office", "--hide-world", env=environment)
    processes.start("mapper", env=environment)
    processes.start("controller", "--world=", env=environment)
    return processes.start("viewer", "--port", "0", env=environment), environment


def test_drive_explore_and_save(browser, processes):
    from tests.viewer.browser import visit  # without playwright these tests are skipped

    viewer, environment = start_mapping(processes)
    seen = visit(browser, page_of(viewer))
    seen.wait("store.map && store.frame?.belief?.estimator === 'mapper'")
    seen.wait("store.frame.truth === null && store.frame.error === null")
    assert seen.see("store.world.name") == "map"
    count = seen.see("store.map.path.length")
    seen.page.locator("#map").focus()
    seen.page.keyboard.down("ArrowUp")
    seen.wait("store.map.path.length > arg", argument=count)
    seen.page.keyboard.up("ArrowUp")

    seen.page.locator("#explore").click()
    seen.toast("exploring")
    count = seen.see("store.map.path.length")
    seen.wait("store.frame.status.exploration?.phase === 'exploring' && store.map.path.length > arg", argument=count)
    seen.wait("document.querySelector('#explore-label').textContent === 'Stop'")
    seen.page.locator("#explore").click()
    seen.toast("goal cancelled")
    seen.wait("store.frame.status.exploration === null && store.frame.status.state === 'idle'")

    save = seen.page.locator("#save-map")
    save.locator("input").fill("here")
    save.locator("button").click()
    assert "presage train --world" in seen.toast("map saved")
    assert load_world(str(Path(processes.folder) / "here.yaml")).grid is not None
    save.locator("button").click()
    seen.toast("exists already", ok=False)

    # The next session, in a known world, on the same page.
    for service in processes.started:
        if service.name in {"simulator", "mapper", "controller"}:
            service.stop(timeout=WAIT_TIMEOUT_S)
    processes.start("simulator", "--world", "maze", env=environment)
    seen.wait("store.map === null && store.world?.name === 'maze' && store.frame.truth !== null")
    seen.page.context.close()
    assert seen.complaints == []
