"""UserError, an error with a one-line message that says what was wrong, where, and what to do."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pydantic import ValidationError


class UserError(Exception):
    """An error that the user can correct: shown as one line, without a traceback; the process ends with status 2."""


# Texts in plain words for pydantic's types of errors; the others have pydantic's message.
_PROBLEMS = {
    "missing": "missing",
    "extra_forbidden": "unknown key",
    "string_type": "expected text, not {input}",
    "list_type": "expected a list, not {input}",
    "tuple_type": "expected a list, not {input}",
    "dict_type": "expected keys with values, not {input}",
    "float_type": "expected a number, not {input}",
    "float_parsing": "expected a number, not {input}",
    "model_type": "expected keys with values, such as {{x: 1, y: 2}}, not {input}",
    "model_attributes_type": "expected keys with values, such as {{x: 1, y: 2}}, not {input}",
    "int_type": "expected a whole number, not {input}",
    "int_parsing": "expected a whole number, not {input}",
    "int_from_float": "expected a whole number, not {input}",
    "finite_number": "expected a finite number, not {input}",
    "bool_type": "expected true or false, not {input}",
    "bool_parsing": "expected true or false, not {input}",
    "literal_error": "expected {expected}, not {input}",
    "greater_than": "must be greater than {gt:.10g}, not {input}",
    "greater_than_equal": "must be at least {ge:.10g}, not {input}",
    "less_than": "must be less than {lt:.10g}, not {input}",
    "less_than_equal": "must be at most {le:.10g}, not {input}",
    "too_short": "too few entries: at least {min_length} are needed, not {actual_length}",
    "too_long": "too many entries: at most {max_length} are allowed, not {actual_length}",
}
NAME_PATTERN = r"^[\w.-]+$"  # of names in files
# What to say of text that does not match a pattern; a module that defines another pattern may add to it.
PATTERN_PROBLEMS = {NAME_PATTERN: "only letters, digits, '.', '-' and '_' may be in a name, not {input}"}


def similar_key(key: str, known: Iterable[str], min_similarity: float = 0.6) -> str | None:
    """The one of the ``known`` keys that was probably meant by an unknown ``key``; None if none is similar.

    ``min_similarity`` is from 0 to 1, where 1 is equality (see `difflib`).
    """
    return next(iter(difflib.get_close_matches(key, sorted(known), 1, min_similarity)), None)


def unknown_key(key: str, known: Iterable[str]) -> str:
    """What to say of a key that is none of the ``known`` ones: the most similar one, or else all."""
    similar = similar_key(key, known)
    hint = f"did you mean {similar!r}?" if similar else f"the keys are {', '.join(sorted(known))}"
    return f"unknown key {key!r}; {hint}"


def first_fault(error: ValidationError) -> str:
    """The first error of a validation in plain words, as ``field.path: problem``."""
    return ": ".join(filter(None, [_location(error.errors(include_url=False)[0]["loc"]), first_problem(error)]))


def first_problem(error: ValidationError) -> str:
    """The problem of the first error of a validation in plain words."""
    first = error.errors(include_url=False)[0]
    context = first.get("ctx", {})
    given = first["input"]
    value = f"{given}" if isinstance(given, (int, float)) else repr(str(given)[:40])
    if first["type"] in _PROBLEMS:
        return _PROBLEMS[first["type"]].format(input=value, **context)
    if problem := PATTERN_PROBLEMS.get(context.get("pattern", "")):
        return problem.format(input=value)
    return str(first["msg"]).removeprefix("Value error, ")


def _location(parts: tuple[int | str, ...]) -> str:
    """The place of an error, such as ``lifts, entry 1, ground``."""
    text, separator = "", ""
    for part in parts:
        if isinstance(part, int) and not isinstance(part, bool):
            text, separator = f"{text}, entry {part + 1}", ", "
        elif part != "[key]":  # pydantic's mark of a key that is itself wrong
            text, separator = f"{text}{separator}{part}", "."
    return text
