"""`python -m tests.viewer.mapping_picture`: docs/mapping-live.png, the page while a robot maps an unknown office."""

from __future__ import annotations

import io
import sys
import tempfile
from contextlib import closing
from pathlib import Path

from PIL import Image

from tests.conftest import ROOT, Processes
from tests.viewer.browser import find_browser, open_browser, visit
from tests.viewer.client import page_of
from tests.viewer.test_mapping import start_mapping

# Places in m from the start, through the doors of the office.
ROUTE = (
    "2.9,-0.4 2.9,2.5 1.8,2.5 2.9,2.5 2.9,-0.4 0.7,-0.4 0.7,-2.5 0.7,-0.4 6.1,-0.4 6.1,-1.9 6.1,-0.4 11.85,-0.4 "
    "11.85,-1.5 11.85,-0.4 9.95,-0.4 9.95,2.5 12.5,2.5 9.95,2.5 9.95,-0.4 3,-0.4"
)
TIMEOUT_S = 600.0
FILE = ROOT / "docs" / "mapping-live.png"


def main() -> None:
    """Drives through the office and writes the picture."""
    path = find_browser()
    if path is None:
        sys.exit("no Chromium; on Debian and Ubuntu: apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder, closing(Processes(Path(folder))) as processes:
        viewer, environment = start_mapping(processes)
        with open_browser(path) as browser:
            seen = visit(browser, page_of(viewer), width=1440, height=900)
            seen.wait("store.map", 60)
            connect = ("--connect", environment["PRESAGE_CONNECT"])
            driver = processes.start("lab.benchmarks.live_mapping", "--route", ROUTE, *connect)
            driver.wait(TIMEOUT_S)
            print(driver.output)
            picture = Image.open(io.BytesIO(seen.page.screenshot())).convert("RGB")
            picture.save(FILE, optimize=True)


if __name__ == "__main__":
    main()
