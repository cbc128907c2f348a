"""`python -m tests.viewer.mapping_picture`: docs/mapping-live.png, the page after a robot has explored an office."""

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

TIMEOUT_S = 600.0
FILE = ROOT / "docs" / "mapping-live.png"


def main() -> None:
    """Explores the office and writes the picture."""
    path = find_browser()
    if path is None:
        sys.exit("no Chromium; on Debian and Ubuntu: apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder, closing(Processes(Path(folder))) as processes:
        viewer, _ = start_mapping(processes)
        with open_browser(path) as browser:
            seen = visit(browser, page_of(viewer), width=1440, height=900)
            seen.wait("store.map")
            seen.page.locator("#explore").click()
            seen.wait("store.frame.status.exploration?.phase === 'finished'", TIMEOUT_S)
            seen.wait("document.querySelector('#explore-label').textContent === 'Explore'")
            picture = Image.open(io.BytesIO(seen.page.screenshot())).convert("RGB")
            picture.save(FILE, optimize=True)


if __name__ == "__main__":
    main()
