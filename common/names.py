"""Names in the text of an option."""

from __future__ import annotations


def split_names(text: str) -> list[str]:
    """The comma-separated names, or endpoints, in ``text``, without spaces around them and without empty ones."""
    return [name.strip() for name in text.split(",") if name.strip()]
