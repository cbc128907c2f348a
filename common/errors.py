"""UserError, an error with a one-line message that says what was wrong, where, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError


class UserError(Exception):
    """An error that the user can correct: shown as one line, without a traceback; the process ends with status 2."""


def first_fault(error: ValidationError) -> str:
    """The first error of a validation, as ``field.path: problem``."""
    first = error.errors(include_url=False)[0]
    problem = str(first["msg"])
    if first["type"] in ("model_type", "model_attributes_type"):  # pydantic's message names an internal class
        problem = f"expected keys with values, such as {{x: 1, y: 2}}, not {str(first['input'])[:40]!r}"
    return ": ".join(filter(None, [".".join(map(str, first["loc"])), problem]))
