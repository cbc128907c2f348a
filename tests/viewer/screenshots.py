"""`make screenshots`: docs/page.png and docs/page.webp, of a real session in a real browser.

A robot drives through an office with people, is carried away, localises itself, and continues to its goal.
"""

from __future__ import annotations

import argparse
import io
import re
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

from PIL import Image

from tests.conftest import ROOT, Processes
from tests.viewer.browser import Visit, find_browser, open_browser, visit

WORLD = ("--world", "office")
SERVICES = {
    "simulator": (*WORLD, "--people", "3", "--seed", "4"),
    "estimator": WORLD,
    "controller": (*WORLD, "--belief-timeout", "5"),  # pictures are taken on the same machine
}
GOAL, FACING = (16.5, 6.5), (16.5, 5.6)  # m in map, where the pointer is put down and let go
ELSEWHERE = (11.8, 1.2)  # m, where the robot is carried
BACK = (3.6, 6.4)  # m, the next goal
LARGE, SMALL = {"width": 1440, "height": 900}, {"width": 1100, "height": 740}  # px of the page, still and filmed
FILM = (960, 646)  # px of the animation
PERIOD = 0.15  # s of the robot's time between its pictures, at least
LONGEST = 25.0  # s of the robot's time, of one scene


def start(processes: Processes) -> str:
    """Starts all services. Returns the address of the page."""
    _, port = processes.start_router()
    environment = {"PRESAGE_CONNECT": f"tcp/127.0.0.1:{port}", "PRESAGE_ROBOT": "robot"}
    for name, arguments in SERVICES.items():
        processes.start(name, *arguments, env=environment)
    processes.start("recorder", "--idle", "--directory", str(processes.folder), env=environment)
    viewer = processes.start("viewer", "--port", "0", env=environment)
    viewer.wait_for("page: ")
    match = re.search(r"page: (\S+)", viewer.output)
    assert match is not None
    return match[1]


def picture(seen: Visit) -> Image.Image:
    """A screenshot."""
    return Image.open(io.BytesIO(seen.page.screenshot())).convert("RGB")


def film(seen: Visit, ends: str) -> list[tuple[float, Image.Image]]:
    """Small pictures of the page until an expression is true, each with the robot's time."""
    began = now = seen.see("store.frame.t")
    pictures = []
    while now < began + LONGEST and not seen.see(ends):
        pictures.append((now, picture(seen).resize(FILM, Image.Resampling.LANCZOS)))
        seen.wait("store.frame.t > arg", argument=now + PERIOD)
        now = seen.see("store.frame.t")
    return pictures


def quiet(seen: Visit) -> None:
    """Hides answers and the ring around the focused element."""
    seen.page.evaluate("document.getElementById('toasts').replaceChildren(); document.activeElement.blur()")


def play(seen: Visit) -> tuple[Image.Image, list[tuple[float, Image.Image]]]:
    """Drives and carries the robot. Returns a still picture and the frames of the animation."""
    tracked = "store.frame?.belief?.state === 'tracking' && Math.abs(store.frame.belief.x - store.frame.truth.x) < 0.1"
    seen.wait(f"{tracked} && store.history.t.length > 60", 90)
    seen.page.set_viewport_size(SMALL)
    seen.page.locator("#speed").select_option("0.5")  # pictures take their time
    seen.drag(GOAL, FACING)
    seen.wait("store.frame.speed > 0.1 && store.prior", 60)
    quiet(seen)
    pictures = film(seen, "store.frame.truth.x > 4.5")
    seen.page.keyboard.down("Shift")
    seen.click(*ELSEWHERE)
    seen.page.keyboard.up("Shift")
    pictures += film(seen, "store.frame.status?.state === 'reached'")
    seen.page.set_viewport_size(LARGE)
    seen.page.locator("#speed").select_option("1")
    seen.click(*BACK)
    seen.wait(f"{tracked} && store.frame.truth.x < 11.5 && store.frame.speed > 0.7 && store.frame.path.length", 60)
    quiet(seen)
    return picture(seen), pictures


def main() -> None:
    """Writes both pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of page.png and page.webp")
    parser.add_argument("--dark", action="store_true", help="the page's dark colours")
    args = parser.parse_args()
    path = find_browser()
    if path is None:
        sys.exit("screenshots: no Chromium; on Debian and Ubuntu: apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder:
        processes = Processes(Path(folder))
        try:
            address = start(processes)
            with open_browser(path) as browser:
                colours = "dark" if args.dark else "light"
                seen = visit(browser, address, **LARGE, device_scale_factor=1.25, color_scheme=colours)
                still, pictures = play(seen)
        finally:
            processes.close()
    still.save(args.out / "page.png", optimize=True)
    times = [t for t, _ in pictures]
    durations = [int(1000 * min(0.5, max(0.05, after - t))) for t, after in pairwise(times)] + [1500]
    first, *rest = [image for _, image in pictures]
    first.save(
        args.out / "page.webp", save_all=True, append_images=rest, duration=durations, loop=0, quality=60, method=4
    )
    for name in ("page.png", "page.webp"):
        print(f"{args.out / name}: {(args.out / name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
