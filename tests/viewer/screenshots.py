"""`make screenshots`: docs/page.png and docs/page.webp, of real sessions in a real browser.

The still shows a robot in an office with people, and the moving picture shows `presage demo --unknown`.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

from PIL import Image

from tests.conftest import ROOT, Processes
from tests.viewer.browser import Visit, find_browser, open_browser, visit
from tests.viewer.client import page_of

WORLD = ("--world", "office")
SERVICES = {
    "simulator": (*WORLD, "--people", "3", "--seed", "4"),
    "estimator": WORLD,
    "controller": (*WORLD, "--belief-timeout", "5"),  # pictures are taken on the same machine
}
GOAL = (16.5, 6.5)  # m in map
LARGE, SMALL = {"width": 1440, "height": 900}, {"width": 960, "height": 540}  # px of the page, still and filmed
# Only the map is filmed: while mapping, there is neither a free energy nor a true pose to draw.
FILM_STYLE = """.panels { display: none; }
main { grid-template: 1fr / 1fr !important; }
.dock, .zoom, .legend { visibility: hidden; }
.notices { position: absolute; inset: auto 10px 10px; }"""
PERIOD, SPEED_UP = 1.0, 8.0  # s of the robot's time between the pictures of the animation; how much faster it plays
END_MS = 2500  # for which the last picture is shown


def start(processes: Processes) -> str:
    """Starts all services. Returns the address of the page."""
    _, port = processes.start_router()
    environment = {"PRESAGE_CONNECT": f"tcp/127.0.0.1:{port}", "PRESAGE_ROBOT": "robot"}
    for name, arguments in SERVICES.items():
        processes.start(name, *arguments, env=environment)
    processes.start("recorder", "--idle", "--directory", str(processes.folder), env=environment)
    return page_of(processes.start("viewer", "--port", "0", env=environment))


def picture(seen: Visit) -> Image.Image:
    """A screenshot."""
    return Image.open(io.BytesIO(seen.page.screenshot())).convert("RGB")


def quiet(seen: Visit) -> None:
    """Hides answers and the ring around the focused element."""
    seen.page.evaluate("document.getElementById('toasts').replaceChildren(); document.activeElement.blur()")


def still(seen: Visit) -> Image.Image:
    """A picture of the robot on its way."""
    tracked = "store.frame?.belief?.state === 'tracking' && Math.abs(store.frame.belief.x - store.frame.truth.x) < 0.1"
    seen.wait(f"{tracked} && store.history.t.length > 60")
    seen.click(*GOAL)
    seen.wait(f"{tracked} && store.frame.truth.x > 8 && store.frame.speed > 0.7")
    quiet(seen)
    return picture(seen)


def film(seen: Visit) -> list[tuple[float, Image.Image]]:
    """Small pictures of the page until the robot is back, each with the robot's time."""
    seen.wait("store.map && store.frame?.status?.exploration")
    seen.page.locator("#speed").select_option("0.5")  # pictures take their time
    seen.page.add_style_tag(content=FILM_STYLE)
    seen.see("document.getElementById('legend').open = false")
    pictures = []
    while seen.see("store.frame.status.exploration.phase") != "finished":
        now = seen.see("store.frame.t")
        quiet(seen)
        pictures.append((now, picture(seen)))
        seen.wait("store.frame.t > arg || store.frame.status.exploration.phase === 'finished'", argument=now + PERIOD)
    return pictures


def record_still(chromium: str, file: Path, **options: Any) -> None:
    """Writes the still picture."""
    with tempfile.TemporaryDirectory() as folder, closing(Processes(Path(folder))) as processes:
        address = start(processes)
        with open_browser(chromium) as browser:
            still(visit(browser, address, **LARGE, device_scale_factor=1.25, **options)).save(file, optimize=True)


def record_film(chromium: str, file: Path, **options: Any) -> None:
    """Writes the moving picture."""
    with tempfile.TemporaryDirectory() as folder, closing(Processes(Path(folder))) as processes:
        demo = processes.start("presage.__main__", "demo", "--unknown", env={"PRESAGE_VIEWER_PORT": "0"})
        demo.wait_for("\npage: ", 120)  # the demo's own line, after that of the viewer
        address = page_of(demo)
        with open_browser(chromium) as browser:
            pictures = film(visit(browser, address, **SMALL, bypass_csp=True, **options))
        demo.wait(60)
        print(demo.output)
    durations = [int(1000 * (after - t) / SPEED_UP) for (t, _), (after, _) in pairwise(pictures)] + [END_MS]
    first, *rest = [image for _, image in pictures]
    first.save(file, save_all=True, append_images=rest, duration=durations, loop=0, quality=60, method=4)


RECORDERS = {"page.png": record_still, "page.webp": record_film}


def main() -> None:
    """Writes the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(RECORDERS), help="page.png or page.webp; defaults to both")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the pictures")
    parser.add_argument("--dark", action="store_true", help="the page's dark colours")
    args = parser.parse_args()
    chromium = find_browser()
    if chromium is None:
        sys.exit("screenshots: no Chromium; on Debian and Ubuntu: apt-get install chromium")
    for name in args.names:
        file = args.out / name
        RECORDERS[name](chromium, file, color_scheme="dark" if args.dark else "light")
        print(f"{file}: {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
