"""Writes docs/messages.md from the source."""

from __future__ import annotations

import ast
import inspect
import json
from typing import Any

from pydantic import BaseModel

from common.geometry import occupancy_grid, world
from common.geometry import shapes as furniture
from common.limits import MAX_BEAMS, MAX_COORDINATE_M, MAX_DISTANCE_M
from common.messages import definitions as messages
from common.messages import pose, requests
from common.messages.topics import MAX_BYTES, QUERIES, ROOT, TOPICS, alive_key
from common.robot import base as robot
from common.robot import scanner

HEAD = f"""# Messages

Written by `python -m common.messages.reference > docs/messages.md` from `topics.py`, `messages.py` and
`requests.py` in `common/`; do not edit.

Keys are `{ROOT}/<robot>/<topic>`. A payload is one MessagePack map with the field names below; a field with a
default may be left out, an unknown one is ignored. *Binary* fields are MessagePack `bin`: little-endian numbers of the
type shown (`<f4` is float32, `<f8` float64, `u1` a byte), row after row. Payloads above {MAX_BYTES >> 20} MiB
({64 * MAX_BYTES >> 20} MiB for requests) are not read. zenoh's encoding is `application/msgpack` with the message's
name as schema. While a service runs, the liveliness token `{alive_key("<robot>", "<service>", "<instance>")}` stands.

Positions are within ±{MAX_COORDINATE_M:g} m of their frame's origin, distances up to {MAX_DISTANCE_M:g} m, and a scan
has at most {MAX_BEAMS} beams (`common/limits.py`). A message with a value outside a field's limits is dropped and
counted as undecodable.

Units are SI. Frames: `map` is the world, `odom` drifts, `base_link` is the robot's centre, `laser` the scanner.
Times are ns of simulation or sensor time, except in health.
"""


def page() -> str:
    """The whole page, Markdown."""
    parts = [HEAD, "## Topics\n", *_topics(), "", "## Queryables\n", *_queries(), "", "## Fields\n"]
    for model in _models():
        parts += _fields(model)
    return "\n".join(parts).rstrip() + "\n"


def _topics() -> list[str]:
    rows = [
        f"| `{t.key('<robot>', '<service>')}` | [{t.message.__name__}](#{t.message.__name__.lower()}) | {t.publisher} "
        f"| {f'{t.rate:g} Hz' if t.rate else 'at need'} | {t.queue} | {'yes' if t.recorded else 'no'} | {t.about} |"
        for t in TOPICS
    ]
    head = "| key | message | published by | rate | a slow receiver keeps | recorded | about |"
    return [head, "|---|---|---|---|---|---|---|", *rows]


def _queries() -> list[str]:
    rows = [
        f"| `{q.key('<robot>', '<service>')}` | [{q.request.__name__}](#{q.request.__name__.lower()}) "
        f"| [{q.reply.__name__}](#{q.reply.__name__.lower()}) | {q.server} | {q.about} |"
        for q in QUERIES
    ]
    return ["| key | request | reply | answered by | about |", "|---|---|---|---|---|", *rows]


def _models() -> list[type[BaseModel]]:
    found: list[type[BaseModel]] = []
    for module in (pose, messages, requests, furniture, world, occupancy_grid, scanner, robot):
        mine = [c for c in vars(module).values() if inspect.isclass(c) and issubclass(c, BaseModel)]
        found += [
            c
            for c in mine
            if c.__module__ == module.__name__ and not c.__name__.startswith("_") and c is not furniture.Model
        ]
    return found


def _fields(model: type[BaseModel]) -> list[str]:
    about = inspect.cleandoc(model.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    lines = [f"### {model.__name__}\n", f"{about}\n"]
    if not model.model_fields:
        return [*lines, "No fields.\n"]
    said = comments(model)
    schema = model.model_json_schema(mode="serialization")
    rows = []
    for name, field in model.model_fields.items():
        default = "required" if field.is_required() else _plain(field.default)
        rows.append(f"| `{name}` | {_kind(schema['properties'][name])} | {default} | {said.get(name, '')} |")
    return [*lines, "| field | type | default | meaning |", "|---|---|---|---|", *rows, ""]


def _kind(schema: dict[str, Any]) -> str:
    """Type, and the limits that the schema sets."""
    return _type(schema) + _limits(schema)


def _limits(schema: dict[str, Any]) -> str:
    """Of a number or of an array's values, such as ", -10000 to 10000"."""
    if (largest := schema.get("x-largest")) is not None:
        rows = f", N at most {schema['x-max-rows']}" if "x-max-rows" in schema else ""
        return f"{rows}, finite values within ±{largest:g}"
    low, high = schema.get("minimum"), schema.get("maximum")
    if high is None or schema.get("type") not in ("number", "integer"):
        return ""
    return f", {low:g} to {high:g}" if low is not None else f", above {schema['exclusiveMinimum']:g}, up to {high:g}"


def _type(schema: dict[str, Any]) -> str:  # noqa: PLR0911 - one line a kind
    if "$ref" in schema:
        name = str(schema["$ref"]).rsplit("/", 1)[-1]
        return f"[{name}](#{name.lower()})"
    if "anyOf" in schema:
        return " or ".join(_kind(option) for option in schema["anyOf"])
    if "x-dtype" in schema:
        shape = schema["x-shape"]
        return f"binary `{schema['x-dtype']}` ({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if schema.get("type") == "array" and "items" in schema:
        return f"array of {_kind(schema['items'])}"
    if schema.get("type") == "object" and isinstance(schema.get("additionalProperties"), dict):
        return f"map of {_kind(schema['additionalProperties'])}"
    return str(schema.get("type", "any"))


def _plain(value: object) -> str:
    if isinstance(value, BaseModel):
        return "`" + ", ".join(f"{k} {v:g}" for k, v in value.model_dump().items()) + "`"
    if hasattr(value, "tolist"):
        value = value.tolist()
    return "nil" if value is None else f"`{json.dumps(value)}`"


def comments(model: type[BaseModel]) -> dict[str, str]:
    """What each field means, with its unit, as the source says it; inherited fields too."""
    found: dict[str, str] = {}
    for ancestor in reversed(model.__mro__):
        if issubclass(ancestor, BaseModel) and ancestor is not BaseModel:
            found |= _comments(ancestor)
    return found


def _comments(model: type[BaseModel]) -> dict[str, str]:
    """What stands behind each field in the source, or in a comment line right below it."""
    lines = inspect.getsource(model).splitlines()
    body = ast.parse("\n".join(lines)).body[0]
    assert isinstance(body, ast.ClassDef)  # noqa: S101 - it is the source of a class
    found: dict[str, str] = {}
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.end_lineno is not None:
            behind, below = lines[node.end_lineno - 1][node.end_col_offset :], (*lines, "")[node.end_lineno]
            said = [part.split("#", 1)[1] for part in (behind, below) if part.lstrip().startswith("#")]
            meant = [part.strip() for part in said if not part.strip().startswith("noqa")]
            found[node.target.id] = " ".join(meant).replace("|", "\\|")
    return found


if __name__ == "__main__":
    print(page(), end="")
