"""Writes the list of folders in docs/architecture.md: `python -m tests.folder_list`."""

from __future__ import annotations

import ast
import re
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "architecture.md"
PACKAGES = ("common", "services", "presage", "lab")
MARKS = re.compile(r"(<!-- folders -->\n).*?(<!-- end -->)", re.DOTALL)
COLUMN = 38  # at which the descriptions begin


def fill(page: str) -> str:
    """Returns the page with the list of folders between its marks."""
    lines = "\n".join(line for package in PACKAGES for line in _tree(package))
    return MARKS.sub(lambda marks: f"{marks[1]}```\n{lines}\n```\n{marks[2]}", page)


def _tree(package: str) -> list[str]:
    """One line for each folder: its name, and the first line of its docstring."""
    inits = sorted((ROOT / package).rglob("__init__.py"), key=lambda init: init.parent)
    return [_line(f"{init.parent.relative_to(ROOT).as_posix()}/", init) for init in inits]


def _line(name: str, file: Path) -> str:
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return textwrap.fill(
        docstring.partition("\n")[0],
        118,
        initial_indent=f"{name:{COLUMN - 2}}  ",
        subsequent_indent=" " * COLUMN,
        drop_whitespace=True,
    ) or name  # fmt: skip


if __name__ == "__main__":
    PAGE.write_text(fill(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
