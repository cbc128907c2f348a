"""Parses the YAML of worlds and maps, fast and with size limits."""

from __future__ import annotations

from typing import Any

import yaml

MAX_NODES = 1_000_000  # 10 000 obstacles need about 200 000
MAX_DEPTH = 100
# PyYAML's C parser, ten times as fast, is missing where PyYAML was built without libyaml.
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class TooLargeError(ValueError):
    """Beyond the limits."""


def parse_yaml(text: str | bytes) -> Any:
    """The value that ``text`` describes.

    Raises yaml.YAMLError or ValueError (a date such as 2020-13-45) where it is no YAML, and TooLargeError where it is
    beyond the limits. These are checked first: the C loader crashes the process on 100 000 nested brackets, and takes
    long for what no world can hold.
    """
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=LOADER)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise TooLargeError(f"more than {MAX_DEPTH} levels of brackets or indentation")
        if count > MAX_NODES:
            raise TooLargeError(f"more than {MAX_NODES} values, which is more than any world has")
    return yaml.load(text, Loader=LOADER)  # noqa: S506 - a safe loader, in C or in Python
