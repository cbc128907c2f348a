"""Parses YAML files, fast and with size limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import yaml

MAX_NODES = 1_000_000  # 10 000 obstacles need about 200 000
MAX_DEPTH = 100  # much deeper nesting crashes the C parser
NOT_YAML = (yaml.YAMLError, ValueError)  # raised by `parse_yaml`
# PyYAML's C parser is ten times as fast, but missing if PyYAML was built without libyaml.
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class TooLargeError(ValueError):
    """Raised for YAML with more values or deeper nesting than the limits allow."""


@dataclass
class _Node:
    """A sequence or mapping while it is read."""

    is_mapping: bool = False
    keys: set[str] = field(default_factory=set)
    is_key_next: bool = True

    def add(self, event: yaml.NodeEvent) -> None:
        """Takes note of the next key, value or item; raises ValueError if it is a key that was given before."""
        if not self.is_mapping:
            return
        if self.is_key_next and isinstance(event, yaml.ScalarEvent):
            if event.value in self.keys:
                where = "" if event.start_mark is None else f"line {event.start_mark.line + 1}: "
                raise ValueError(f"{where}{event.value!r} is given twice")
            self.keys.add(event.value)
        self.is_key_next = not self.is_key_next


def parse_yaml(text: str | bytes) -> Any:
    """Parses ``text`` safely.

    Raises yaml.YAMLError or ValueError (for a date such as 2020-13-45) if it is not valid YAML, and TooLargeError if it
    exceeds the limits. The limits are checked before loading, because 100 000 nested brackets crash the process in the
    C loader and many values take long to load. A key that is given twice is not valid, but PyYAML would accept it.
    """
    open_nodes: list[_Node] = [_Node()]
    for count, event in enumerate(yaml.parse(text, Loader=LOADER)):
        if isinstance(event, yaml.NodeEvent):
            open_nodes[-1].add(event)
        if isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append(_Node(is_mapping=isinstance(event, yaml.MappingStartEvent)))
        elif isinstance(event, yaml.CollectionEndEvent):
            open_nodes.pop()
        if len(open_nodes) > MAX_DEPTH:
            raise TooLargeError(f"more than {MAX_DEPTH} levels of brackets or indentation")
        if count > MAX_NODES:
            raise TooLargeError(f"more than {MAX_NODES} values")
    return yaml.load(text, Loader=LOADER)  # noqa: S506 - a safe loader, in C or in Python
