"""The page in a real browser with artificial sessions: all states, several widths, mouse, touch and keyboard."""

from __future__ import annotations

import re
import signal

import numpy as np
import pytest

from common.bus.bus import wait_until
from common.geometry.cell_distance import signed_distance
from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from tests.conftest import WAIT_TIMEOUT_S, accepts, free_tcp_port
from tests.viewer.stub_server import MAPPED

browser_tools = pytest.importorskip("tests.viewer.browser", reason="NO PLAYWRIGHT: the page is not tested")
SCENES = ("floors", "planning", "blocked", "exploring", "ambiguous", "lost", "no-estimator", "empty", "watch-only")
STANDING = {"blocked", "exploring", "ambiguous", "lost"}  # scenes that show a reason
PHONE = {"width": 360, "height": 740, "has_touch": True, "is_mobile": True}
NAMELESS = """[...document.querySelectorAll("button")].filter(
    (button) => !(button.innerText.trim() || button.getAttribute("aria-label"))).length"""
CUT_OFF = """[...document.querySelectorAll(".keys, .services .scroll, .card h2, .vitals dd, #why")].filter(
    (box) => box.offsetParent && box.scrollWidth > box.clientWidth + 1).map((box) => box.id || box.className)"""
VISIBLE = "document.getElementById(arg).checkVisibility()"
OVERLAPPING = """((boxes) => boxes.filter(([, a], i) => boxes.some(([, b], k) => k < i && a.left < b.right - 1
    && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1)).map(([name]) => name))(
    ["#legend", "#zoom", ".floor", "#why", "#sub", "#toolbar", "#joystick"]
        .map((name) => [name, document.querySelector(name)])
        .filter(([, box]) => box.checkVisibility()).map(([name, box]) => [name, box.getBoundingClientRect()]))"""
TOOLS = """[...document.querySelectorAll("#toolbar button, #toolbar .speed")]
    .filter((tool) => tool.checkVisibility()).map((tool) => {
    const { left, right, bottom, height } = tool.getBoundingClientRect(), label = tool.querySelector("span");
    return { left, right, bottom, height, text: label.checkVisibility() ? label.innerText : "" };
})"""
COLOURS_AT_LEFT = """((canvas, copy) => {
    Object.assign(copy, { width: 1, height: canvas.height });
    const context = copy.getContext("2d", { willReadFrequently: true });
    context.drawImage(canvas, 0, 0);
    return new Set(new Uint32Array(context.getImageData(0, 0, 1, copy.height).data.buffer)).size;
})(document.getElementById(arg), document.createElement("canvas"))"""  # 1: nothing is drawn there
LARGE_NUMBERS = """(() => {
    for (const name of ["free_energy", "complexity", "speed"]) store.history[name].fill(-123456.5);
    store.frame.ranges[0] = 12345;
    for (const layer of ["measured", "predicted"]) view.show(layer, false); // its beams may cross the whole picture
    store.world.boundary = [[-10, -10], [20, -10], [20, 20], [-10, 20]];
    view.fit();
    for (const canvas of document.querySelectorAll(".card canvas")) canvas.style.width = "99%"; // draws it again
})()"""
PIXEL = """((copy) => {
    copy.drawImage(document.getElementById("map"), ...arg.map((px) => px * devicePixelRatio), 1, 1, 0, 0, 1, 1);
    return String(copy.getImageData(0, 0, 1, 1).data);
})(document.createElement("canvas").getContext("2d", { willReadFrequently: true }))"""
TWO_METRES_TO_GO = """((field) => {
    const i = field.distance.findLastIndex((d) => d > 1.9 && d < 2.1), { origin, resolution: cell, width } = field;
    return [origin.x + (i % width + 0.5) * cell, origin.y + (Math.floor(i / width) + 0.5) * cell];
})(store.fieldOfGoal)"""


@pytest.fixture(scope="module")
def stub(module_processes):
    """Address of the stub server."""
    port = free_tcp_port()
    module_processes.start("tests.viewer.stub_server", "--port", str(port))
    assert wait_until(lambda: accepts(port), WAIT_TIMEOUT_S)
    return f"http://127.0.0.1:{port}"


@pytest.fixture
def look(browser, stub):
    """A function that opens a scene. Fails if the browser's console has messages."""
    visits = []

    def start(scene, **options):
        visits.append(browser_tools.visit(browser, f"{stub}/{scene}/", **options))
        visits[-1].wait("store.servicesKnown")
        return visits[-1]

    yield start
    for seen in visits:
        seen.see("presage.connection.request('resume')")  # for the next visitor of the scene
        seen.page.context.close()
        assert seen.complaints == []


@pytest.mark.parametrize("scene", SCENES)
def test_scenes_on_a_phone(look, scene):
    seen = look(scene, **PHONE, color_scheme="dark")
    assert seen.see("document.documentElement.scrollWidth") <= 360
    assert seen.see(
        "matchMedia('(prefers-color-scheme: dark)').matches && document.documentElement.hasAttribute('data-dark')"
    )
    assert seen.see(NAMELESS) == 0
    seen.wait(f"{VISIBLE} === {str(scene == 'empty').lower()}", argument="empty")
    if scene == "watch-only":
        seen.wait(f"{VISIBLE} && document.getElementById('pause').disabled", argument="watch-only")
    if scene == "no-estimator":
        assert "python -m services.estimator" in seen.page.locator(".notice code").inner_text()
    if scene not in {"empty", "no-estimator"}:
        seen.wait("store.frame?.status")
        seen.wait(f"{VISIBLE} === {str(scene in STANDING).lower()} && !{OVERLAPPING}.length", argument="why")


def test_widths_and_layouts(look):
    seen = look("blocked", width=800, height=820)
    seen.wait("store.frame?.status && !document.getElementById('why').hidden")
    for width in (800, 1181, 1300, 1920):
        seen.page.set_viewport_size({"width": width, "height": 820})
        for layout in ("wide", "side"):
            if seen.see("document.getElementById('main').dataset.layout") != layout:
                seen.page.locator("#layout").click()
            seen.wait(
                f"document.documentElement.scrollWidth <= {width} && !{CUT_OFF}.length && !{OVERLAPPING}.length", 5
            )


def test_tools_on_a_phone(look):
    seen = look("planning", **PHONE)
    seen.wait("store.world && store.frame && modes.canControl")
    assert seen.see("view.shown.field") is False  # which on a wide screen is shown
    for width, height in ((360, 640), (390, 844), (844, 390)):
        seen.page.set_viewport_size({"width": width, "height": height})
        seen.wait(f"innerWidth === {width}")
        tools = seen.see(TOOLS)
        names = {"Goal", "Carry", "Obstacle", "Look", "Pause", "Restart", "Speed", "Localise", "Record", "Open"}
        assert names < {tool["text"] for tool in tools}
        for tool in tools:
            assert tool["left"] >= 0, tool
            assert tool["right"] <= width, tool
            assert min(tool["right"] - tool["left"], tool["height"]) >= 44, tool
            assert height < 640 or tool["bottom"] <= height, tool  # all of them without scrolling


def test_plan_drawn_and_hidden(look):
    seen = look("planning", color_scheme="light")
    seen.wait("store.fieldOfGoal && store.frame.path.length > 4")
    seen.wait("store.frame.obstacles.length && store.frame.people.length")
    assert seen.see("view.shown.field") is True
    seen.page.keyboard.press(" ")  # nothing moves any more
    seen.wait("store.paused")
    place, person = seen.see(TWO_METRES_TO_GO), seen.see("[...store.frame.people.slice(0, 2)]")
    plain = seen.see("[...store.fieldOfGoal.distance].filter(Number.isFinite).length")
    assert 0 < plain < seen.see("store.fieldOfGoal.distance.length")
    for layer, where in (("field", place), ("truth", person)):
        at = seen.see("view.camera.toScreen(arg[0], arg[1])", where)
        shown = seen.see(PIXEL, at)
        seen.page.locator(f'[data-layer="{layer}"]').click()
        seen.wait(f"{PIXEL} !== '{shown}'", argument=at)


def test_cells_of_a_ros_map(look):
    seen = look("mapped", color_scheme="light")
    for layer in ("measured", "predicted", "belief", "truth"):
        seen.page.locator(f'[data-layer="{layer}"]').click()
    colours = {OCCUPIED: "61,66,72,255", UNKNOWN: "233,233,229,255", FREE: "255,255,255,255"}  # base.css
    for kind, colour in colours.items():
        inner = signed_distance(MAPPED.grid.values != kind, np.arange(260) + 0.5, np.arange(260) + 0.5)
        for row, column in np.argwhere(inner > 1)[[20, 200, -200, -20]]:  # deep enough that no edge is blended in
            x, y = MAPPED.grid.geometry.points_in_cells(np.array([[column, row]]), 0.5)[0].tolist()
            at = seen.see("view.camera.toScreen(...arg)", [x, y])
            if kind == OCCUPIED:
                near = f"'{colour}'.split(',').every((value, i) => Math.abs(value - {PIXEL}.split(',')[i]) < 3)"
                seen.wait(near, argument=at)  # a small picture is smoothed, which rounds
            else:  # lines of the metres run through all of them
                shown = [seen.see(PIXEL, [at[0] + off, at[1] + off]) for off in (-2, 0, 2)]
                assert colour in shown, (kind, x, y, shown)


def test_floors(look):
    seen = look("floors")
    seen.wait("store.frame && view.floor?.name === 'ground'")
    ground, first = seen.see("store.world.floors.map((floor) => floor.boundary)")
    centre, choice = "[view.camera.x, view.camera.y]", seen.page.locator("#floor")
    on_ground, on_first = ((np.min(ring, 0) + np.max(ring, 0)) / 2 for ring in (ground, first))
    assert choice.locator("option").all_inner_texts() == ["robot’s floor", "all floors", "ground", "first"]
    assert np.abs(seen.see(centre) - on_ground).max() < 3  # m, because the tools cover a part of the map
    choice.select_option("first")
    assert np.abs(seen.see(centre) - on_first).max() < 3
    place = [first[0][0] + 2.0, first[0][1] + 1.2]
    seen.click(*place)
    seen.wait("Math.abs(store.frame.status.goal.x - arg) < 0.1", argument=place[0])
    assert re.fullmatch(r"Going to \(2\.\d\d, 1\.\d\d\) on floor 'first'", seen.toast())
    choice.select_option("robot’s floor")
    assert seen.see("view.floor.name") == "ground"
    seen.see("presage.actions.teleport({ x: arg[0], y: arg[1], yaw: 0 })", place)
    seen.wait("view.floor.name === 'first'")
    assert np.abs(seen.see(centre) - on_first).max() < 3
    choice.select_option("all floors")
    assert seen.see("view.floor") is None
    plain = look("tracking")
    plain.wait("store.world && document.getElementById('floor').parentElement.hidden")


def test_reason_and_journal(look):
    seen = look("blocked")
    seen.wait("store.journal.length > 3 && store.frame?.status")
    why = seen.page.locator("#why")
    why.wait_for()
    reason = seen.see("store.frame.status.reason")
    assert len(reason) > 80
    assert why.inner_text().split(":", 1)[1].strip() == reason
    rows = seen.page.locator("#journal li")
    seen.wait("document.querySelectorAll('#journal li').length === store.journal.length")
    assert reason in rows.first.inner_text()
    assert "idle" in rows.last.inner_text()


def test_goals_by_drag(look):
    seen = look("tracking")
    seen.wait("store.world && store.frame")
    seen.drag((12.0, 1.5), (12.0, 2.5))
    seen.wait("store.frame.status.goal.yaw_tolerance === 0.15")
    assert seen.see("store.frame.status.goal.yaw") == pytest.approx(1.571, abs=0.05)
    seen.click(10.6, 3.75)
    assert "does not fit" in seen.toast(ok=False)
    assert not seen.see("view.gesture.selected")
    seen.page.keyboard.press("o")
    seen.click(10.6, 3.75)
    assert seen.see("view.gesture.selected") == "cylinder"


def test_escape_during_a_drag(look):
    seen = look("tracking")
    seen.wait("store.world && store.frame")
    seen.page.mouse.move(*seen.at(12.0, 1.5))
    seen.page.mouse.down()
    seen.page.mouse.move(*seen.at(12.0, 2.5), steps=4)
    assert seen.see("view.gesture.goal") is not None
    seen.page.keyboard.press("Escape")
    seen.page.mouse.move(*seen.at(13.0, 2.5), steps=4)
    seen.page.mouse.up()
    seen.drag((11.0, 1.5), (11.0, 2.5))  # a later drag counts
    assert "(11" in seen.toast("Going to")


def test_recording_that_another_program_began(look):
    seen = look("tracking")
    seen.wait("store.services.length")
    assert seen.page.locator("#record-label").inner_text() == "Record"
    seen.see("presage.connection.request = () => Promise.resolve({ ok: true, recording: true })")
    seen.see("(store.services.find((one) => one.name === 'recorder').idle = false, presage.actions.followRecorder())")
    seen.wait("document.getElementById('record-label').textContent === 'Stop'")


def test_controller_that_hangs(look):
    seen = look("tracking")
    seen.wait("store.frame?.status")
    row = {"name": "controller", "state": "silent", "alive": True, "note": "", "idle": False, "rates": []}
    seen.see("(store.takeServices(arg, []), store.takeFrame(store.frame, performance.now()), 0)", [row])
    assert seen.see("store.frame.status") is None


def test_axis_labels(look):
    seen = look("tracking", **PHONE)
    seen.wait("store.world && store.frame")
    seen.see("presage.connection.request('pause')")
    seen.wait("performance.now() - store.arrivals.at(-1) > 500")
    seen.see(LARGE_NUMBERS)
    for name in ("c-energy", "c-complexity", "c-speed", "c-scan", "map"):
        seen.wait(f"{COLOURS_AT_LEFT} === 1", argument=name)


class Fingers:
    """Touches of a touch screen."""

    def __init__(self, seen):
        self.session = seen.page.context.new_cdp_session(seen.page)

    def do(self, kind, *places):
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        self.session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def test_zoom_and_joystick(look):
    seen = look("tracking", **PHONE)
    seen.wait("store.world && store.frame")
    goal, scale = seen.see("[store.frame.status.goal, view.camera.scale]")
    box, fingers = seen.page.locator("#map").bounding_box(), Fingers(seen)
    x, y = box["x"] + 150, box["y"] + 150
    under = seen.see("view.camera.toWorld(150, 150)")
    fingers.do("touchStart", (x - 20, y), (x + 20, y))
    for k in range(1, 9):
        fingers.do("touchMove", (x - 20 - 5 * k, y), (x + 20 + 5 * k, y))
    fingers.do("touchEnd")
    seen.wait("view.camera.scale > 2.5 * arg", argument=scale)
    assert seen.see("view.camera.toWorld(150, 150)") == pytest.approx(under, abs=0.05)
    assert seen.see("[scrollY, visualViewport.scale]") == [0, 1]
    assert seen.see("store.frame.status.goal") == goal

    # The joystick steers the same though the page moves under the thumb.
    seen.see("presage.connection.request = (action, fields) => ((window.sent ??= []).push({ action, ...fields }), "
             "Promise.resolve({ ok: true, reason: '' }))")  # fmt: skip
    box = seen.page.locator("#joystick").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    fingers.do("touchStart", (x, y))
    fingers.do("touchMove", (x, y - 24))
    seen.see("document.getElementById('banner').hidden = false")  # 40 px of something above
    fingers.do("touchMove", (x, y - 25))
    seen.wait("window.sent.length > 3")
    fingers.do("touchEnd")
    seen.wait("window.sent.at(-1).vx === 0")
    *before, last = seen.see("window.sent.filter((one) => one.action === 'drive')")
    assert all(one["vx"] > 0.2 for one in before[2:]), before
    assert (last["vx"], last["wz"]) == (0, 0)


def test_space_key_after_a_click(look):
    seen = look("tracking")
    seen.wait("store.world && store.frame")
    seen.page.locator("#reset").click()
    seen.toast("restarted")
    seen.page.keyboard.press(" ")
    seen.wait("store.paused")
    seen.page.locator("#pause").focus()
    seen.page.keyboard.press("Tab")
    assert seen.see("document.activeElement.id") == "step"  # the focus follows the keyboard


def test_server_that_comes_back(browser, processes):
    port = str(free_tcp_port())
    first = processes.start("tests.viewer.stub_server", "--port", port)
    assert wait_until(lambda: accepts(int(port)), WAIT_TIMEOUT_S)
    seen = browser_tools.visit(browser, f"http://127.0.0.1:{port}/planning/")
    seen.wait("store.arrivals.length > 5 && store.fieldOfGoal")
    first.stop(signal.SIGKILL)
    seen.page.locator("#banner").wait_for(timeout=1000 * WAIT_TIMEOUT_S)
    assert "No connection" in seen.page.locator("#banner").inner_text()
    processes.start("tests.viewer.stub_server", "--port", port)
    seen.page.locator("#banner").wait_for(state="hidden", timeout=1000 * WAIT_TIMEOUT_S)
    seen.wait("store.connected && store.fieldOfGoal && performance.now() - store.arrivals.at(-1) < 500")
    seen.page.context.close()


def test_tools_of_a_real_robot(look):
    seen = look("tracking")
    seen.page.locator("[data-mode=carry]").click()
    rows = [{"name": "estimator", "state": "alive", "alive": True, "note": "", "rates": [], "uptime_s": 1.0}]
    message = {"type": "services", "services": rows, "missing": [], "linked": True}
    take = "((take) => (presage.connection.on.message = () => {}, take(arg)))(presage.connection.on.message)"
    seen.see(take, message)  # no other messages come after it
    names = ["goal", "carry", "obstacle", "look"]
    visible = seen.see("arg.filter((name) => document.querySelector(`[data-mode=${name}]`).checkVisibility())", names)
    assert (visible, seen.see("modes.name")) == (["goal", "look"], "goal")
    assert not seen.page.locator("#pause").is_visible()
    seen.page.keyboard.press(" ")
    seen.toast("only in a simulation", ok=False)
    seen.see("store.takeServices(arg, [{ name: 'simulator' }])", rows)  # the robot's scans pause
    assert seen.see("store.simulated") is False
    seen.see("store.takeServices(arg, [])", [*rows, {**rows[0], "name": "simulator"}])
    assert seen.see("store.simulated") is True


def test_robot_that_was_watched_before_the_viewer_restarted(look):
    seen = look("tracking")
    seen.see("(window.watched = [], presage.actions.watch = (robot) => window.watched.push(robot), 0)")

    def hello(robot, *robots):
        return {"type": "hello", "control": True, "version": "stub", "robots": robots, "robot": robot}

    def watched(*messages):
        """The robots that the page asks for, after each message."""
        take = "arg.map((message) => (presage.connection.on.message(message), window.watched.splice(0).join()))"
        return seen.see(take, messages)

    both = ("robot", "truck")
    assert watched(hello("robot", *both)) == [""]
    seen.page.locator("#robot").select_option("truck")
    assert watched(hello("truck", *both)) == ["truck"]
    seen.see("store.connected = false")
    restarted = [hello("robot", "robot"), hello("robot", *both), hello("truck", *both)]
    # The viewer does not know the truck at once. Then the server shows another robot: a recording was closed.
    assert watched(*restarted, hello("robot", *both)) == ["", "truck", "", ""]
    seen.see("store.connected = false")
    seen.see("performance.now = ((now) => () => now() + (window.later ?? 0))(performance.now.bind(performance))")
    assert watched(hello("robot", "robot")) == [""]
    seen.see("window.later = 60000")
    assert watched(hello("robot", *both)) == [""]  # too late: the visitor looks at another robot


@pytest.mark.parametrize("part", ["js/map.js", "css/base.css"])
def test_page_that_was_loaded_in_part(browser, stub, part):
    context = browser.new_context()
    context.route(f"**/{part}", lambda route: route.abort(), times=1)
    page = context.new_page()
    page.goto(f"{stub}/planning/")
    complete = "window.presage?.store.connected && document.styleSheets.length === 3"
    page.wait_for_function(complete, polling=browser_tools.POLLING_MS, timeout=1000 * WAIT_TIMEOUT_S)
    context.close()


def test_messages_that_are_no_frame(look):
    seen = look("tracking")
    seen.wait("store.world && store.frame")
    before = seen.see("store.frame.t")
    for text in ("", "null", "[]", "7", "{", '{"type": "of a later version"}', '{"id": 1}'):
        seen.see("presage.connection.receive(arg)", text)
    seen.see("[0, 3, 4, 100].forEach((n) => presage.connection.receive(new Uint8Array(n).fill(255).buffer))")
    assert seen.see("presage.connection.undecodable") == 10
    seen.wait("store.frame.t > arg", argument=before)
