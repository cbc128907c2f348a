"""Every command line of `presage` in the documentation and in help texts is one that it understands."""

from __future__ import annotations

import re
import shlex

import pytest
import typer
from typer.main import get_command

from presage.cli.main import app
from tests.conftest import ROOT

GENERATED = {"architecture.md", "messages.md"}
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "Makefile", "docker-compose.yml")),
    *(page for page in sorted((ROOT / "docs").glob("*.md")) if page.name not in GENERATED),
    *sorted((ROOT / "presage" / "cli").glob("*.py")),
    *sorted((ROOT / "lab" / "cli").glob("*.py")),
]
COMMANDS = get_command(app)
USAGE_ERROR = next(cls for cls in typer.BadParameter.__mro__ if cls.__name__ == "UsageError")
NAMES = "|".join(COMMANDS.commands)
# Ends with a code span, a comment, a pipe, a redirection or a continued sentence.
COMMAND_LINE = re.compile(rf"(?:^|[`\s/])presage ((?:{NAMES})\b(?:(?! 2>)[^`#|>;\n])*)", re.MULTILINE)


def problem(words):
    """What is wrong with the words after `presage`, or an empty string."""
    command, parent = COMMANDS, None
    while True:
        try:
            context = command.make_context("presage", words, parent=parent)
            if not hasattr(command, "commands"):
                return ""
            _, command, words = command.resolve_command(context, [*context._protected_args, *context.args])
            parent = context
        except USAGE_ERROR as error:
            # A text may mention a command or option without its arguments.
            mentioned = type(error).__name__ in {"MissingParameter", "BadOptionUsage", "NoArgsIsHelpError"}
            return "" if mentioned else str(error)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_documented_commands(page):
    text = re.sub(r"`\n\s*", "` ", page.read_text())
    wrong = {}
    text = re.sub(r"\$\{\w+:-([\d.]+)\}|\b[XY]\b", lambda m: m[1] or "1", text.replace("$(ARGS)", ""))
    for line in COMMAND_LINE.findall(text):
        if found := problem(shlex.split(line.strip(" .,:)"))):
            wrong[line] = found
    assert not wrong
