"""Writes the list of files in docs/architecture.md: `python -m tests.file_list`."""

from __future__ import annotations

import ast
import re
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "architecture.md"
PACKAGES = ("common", "services", "presage", "lab")
MARKS = re.compile(r"(<!-- files -->\n).*?(<!-- end -->)", re.DOTALL)
COLUMN = 30  # at which the descriptions begin


def fill(page: str) -> str:
    """Returns the page with the list of files between its marks."""
    blocks = "\n".join(f"```\n{_tree(package)}\n```\n" for package in PACKAGES)
    return MARKS.sub(lambda marks: f"{marks[1]}{blocks}{marks[2]}", page)


def _tree(package: str) -> str:
    """One line for each folder and file: its name, and the first line of its docstring."""
    lines = []
    for init in sorted((ROOT / package).rglob("__init__.py")):
        lines.append(_line(f"{init.parent.relative_to(ROOT).as_posix()}/", init))
        files = [file for file in sorted(init.parent.glob("*.py")) if not file.name.startswith("__")]
        lines += [_line(f"  {file.name}", file) for file in files]
    return "\n".join(lines)


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
