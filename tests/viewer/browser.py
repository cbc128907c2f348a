"""A headless Chromium to look at the page with: Debian's, steered by playwright."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from playwright.sync_api import Browser, Error, Page, sync_playwright

from tests.conftest import WAIT_TIMEOUT_S

POLLING_MS = 50  # the default is each frame drawn, but on a busy machine a browser may draw none for a long time
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--force-color-profile=srgb",
]  # fmt: skip

CONNECTED = "() => window.presage && presage.store.connected"
# Chromium drops what it is loading whenever the containers of another test come or go. The page then loads itself
# again, unless it was the document that was dropped.
NETWORK_CHANGED = "ERR_NETWORK_CHANGED"
MAX_LOADS = 100

# An answer is on the screen for some seconds only, and a busy machine may look too late: keep them all.
KEEP_TOASTS = """window.toasts = [];
new MutationObserver((changes) => {
    for (const node of changes.flatMap((change) => [...change.addedNodes])) {
        if (node.matches?.(".toast")) window.toasts.push({ text: node.textContent, ok: node.dataset.ok === "true" });
    }
}).observe(document, { childList: true, subtree: true });"""


def find_browser() -> str | None:
    """Its path: PRESAGE_TEST_BROWSER, or the first of the usual names."""
    asked = os.environ.get("PRESAGE_TEST_BROWSER")
    return asked or next((path for name in NAMES if (path := shutil.which(name))), None)


@contextmanager
def open_browser(path: str) -> Iterator[Browser]:
    """Ended with the block; its profile is a folder of its own that goes with it."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Visit:
    """One open page, and whatever its console complained of."""

    page: Page
    complaints: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Listen before anything is loaded."""
        self.page.on("console", lambda m: self._complain(m.text) if m.type in {"error", "warning"} else None)
        self.page.on("pageerror", lambda error: self._complain(str(error)))
        self.page.on("requestfailed", lambda request: self._complain(f"{request.failure}: {request.url}"))

    def _complain(self, text: str) -> None:
        if NETWORK_CHANGED not in text:
            self.complaints.append(text)

    def see(self, expression: str, argument: Any = None) -> Any:
        """A JavaScript expression's value; `store`, `view` and the like are the page's own."""
        return self.page.evaluate(
            f"(arg) => {{ const {{ store, view, modes }} = presage; return {expression}; }}", argument
        )

    def wait(self, condition: str, argument: Any = None) -> None:
        """Until an expression is true; raises playwright's TimeoutError."""
        body = f"(arg) => {{ const {{ store, view, modes }} = presage; return Boolean({condition}); }}"
        self.page.wait_for_function(body, arg=argument, polling=POLLING_MS, timeout=1000 * WAIT_TIMEOUT_S)

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Pixels of the page at which the map shows a place, m."""
        box = self.page.locator("#map").bounding_box()
        assert box is not None
        px, py = self.see("view.camera.toScreen(arg[0], arg[1])", [x, y])
        return box["x"] + px, box["y"] + py

    def click(self, x: float, y: float) -> None:
        """On the map, m."""
        self.page.mouse.click(*self.at(x, y))

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """On the map, m."""
        self.page.mouse.move(*self.at(*start))
        self.page.mouse.down()
        self.page.mouse.move(*self.at(*end), steps=8)
        self.page.mouse.up()

    def toast(self, text: str = "", *, ok: bool = True) -> str:
        """The first answer with some text in it since the last one returned here, once it was shown."""
        found = "window.toasts.findIndex((toast) => toast.ok === arg[0] && toast.text.includes(arg[1]))"
        self.wait(f"{found} >= 0", argument=[ok, text])
        return str(self.see(f"window.toasts.splice(0, 1 + {found}).at(-1).text", [ok, text]))


def visit(browser: Browser, address: str, *, width: int = 1100, height: int = 760, **options: Any) -> Visit:
    """A page in a context of its own, once its socket is open."""
    context = browser.new_context(viewport={"width": width, "height": height}, **options)
    context.add_init_script(KEEP_TOASTS)
    seen = Visit(context.new_page())
    for _ in range(MAX_LOADS):
        try:
            seen.page.goto(address)
            break
        except Error as error:
            if NETWORK_CHANGED not in str(error):
                raise
    try:
        seen.page.wait_for_function(CONNECTED, polling=POLLING_MS, timeout=1000 * WAIT_TIMEOUT_S)
    except Error as error:
        raise AssertionError(f"the page did not connect; its console: {seen.complaints}") from error
    return seen
