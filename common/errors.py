"""Errors a user can mend: one line that says what was wrong, where, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError


class UserError(Exception):
    """Shown as one line, without a traceback; the process ends with status 2."""


def first_fault(error: ValidationError) -> str:
    """``field.path: what is wrong``, of the first of pydantic's complaints."""
    first = error.errors(include_url=False)[0]
    return ": ".join(filter(None, [".".join(map(str, first["loc"])), str(first["msg"])]))
