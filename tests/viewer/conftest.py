"""A browser for tests of the page."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module")  # ended with it: while playwright is open, no other loop of asyncio can run
def browser():
    """A headless Chromium."""
    tools = pytest.importorskip("tests.viewer.browser", reason="NO PLAYWRIGHT: the page is not tested")
    path = tools.find_browser()
    if path is None:
        pytest.skip("NO CHROMIUM (apt-get install chromium): the page is not tested")
    with tools.open_browser(path) as opened:
        yield opened


@pytest.fixture
def page(browser, system):
    """A visitor of the module's ``system``, whose robot is tracked."""
    from tests.viewer.browser import visit  # without playwright these tests are skipped

    seen = visit(browser, system.address)
    try:
        seen.wait("store.frame?.belief?.state === 'tracking' && store.world")
        yield seen
    finally:
        seen.page.context.close()
    assert seen.complaints == []
