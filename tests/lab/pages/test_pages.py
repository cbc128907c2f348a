"""README and the pages in docs/ show the stored results."""

from __future__ import annotations

import pytest

from lab.pages.tables_page import TABLE_MARKS, fill_tables
from tests.conftest import ROOT

PAGES = [
    page
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    if TABLE_MARKS.search(page.read_text(encoding="utf-8"))
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables(page):
    text = page.read_text(encoding="utf-8")
    command = f"presage experiment --out docs/experiments tables --page {page.relative_to(ROOT)}"
    assert fill_tables(text, ROOT / "docs" / "experiments") == text, f"run: {command}"


def test_pages_with_tables():
    names = ("experiments", "real_logs", "navigation", "results", "integrity", "mapping", "refinement", "exploration")
    assert {"README.md", *(f"{name}.md" for name in names)} <= {page.name for page in PAGES}
