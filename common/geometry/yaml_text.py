"""Parses the YAML of worlds and maps, fast and with size limits."""

from __future__ import annotations

from typing import Any

import yaml

MAX_NODES = 1_000_000  # 10 000 obstacles need about 200 000
MAX_DEPTH = 100  # much deeper nesting crashes the C parser
# PyYAML's C parser is ten times as fast, but missing if PyYAML was built without libyaml.
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class TooLargeError(ValueError):
    """Raised for YAML with more values or deeper nesting than the limits allow."""


def parse_yaml(text: str | bytes) -> Any:
    """Parses ``text`` safely.

    Raises yaml.YAMLError or ValueError (for a date such as 2020-13-45) if it is not valid YAML, and TooLargeError if it
    exceeds the limits. The limits are checked before loading, because 100 000 nested brackets crash the process in the
    C loader and many values take long to load.
    """
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=LOADER)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise TooLargeError(f"more than {MAX_DEPTH} levels of brackets or indentation")
        if count > MAX_NODES:
            raise TooLargeError(f"more than {MAX_NODES} values, which is more than any world has")
    return yaml.load(text, Loader=LOADER)  # noqa: S506 - a safe loader, in C or in Python
