"""Hypothesis strategies for all messages, derived from their fields, so that new messages are tested as well."""

from __future__ import annotations

import functools
import types
import typing

import annotated_types
import numpy as np
from hypothesis import strategies as st
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.world import Box, Circle, Obstacle, World
from common.messages.definitions import Belief, BeliefHypothesis, Map, Preference, Scan
from common.messages.topics import QUERIES, TOPICS
from common.messages.wire import Binary, Message
from common.robot.robot import Robot
from common.robot.scanner import Scanner

WORLD = World(
    name="w",
    boundary=[(0.0, 0.0), (5.0, 0.0), (5.0, 4.0)],
    obstacles=[
        Obstacle(box=Box(center=(1.0, 1.0), size=(0.5, 0.2), yaw_deg=3.0)),
        Obstacle(circle=Circle(center=(2, 1), radius=1)),
    ],
)
# Types whose constraints concern several fields: a few examples are used.
FIXED: dict[type, st.SearchStrategy] = {
    World: st.just(WORLD),
    Obstacle: st.sampled_from([*WORLD.obstacles, Obstacle(name="p", polygon=[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])]),
    OccupancyGrid: st.just(OccupancyGrid.of(np.array([[0, 100, 255]], np.uint8), 0.05, (1.0, 2.0, 0.0))),
    Scanner: st.builds(
        lambda beams: Scanner(name="s", beams=beams, fov=1.0, rate=15.0, range_min=0.0, range_max=9.0, sigma=0.0),
        st.integers(2, 1000),
    ),
    Robot: st.sampled_from([Robot(), Robot(drive="differential", radius=0.3)]),
}


def message_of(cls: type[Message]) -> st.SearchStrategy:
    """Valid messages of a class."""
    rows = {name: _field(field) for name, field in cls.model_fields.items()}
    if cls in (Belief, BeliefHypothesis):
        three = st.builds(np.array, st.lists(st.floats(-1e6, 1e6, width=64), min_size=9, max_size=9))
        rows["covariance"] = st.none() | three.map(lambda m: m.reshape(3, 3) @ m.reshape(3, 3).T)
    if cls is Scan:
        rows["angle_increment"] = st.sampled_from([-0.1, 1e-3, 1.0])
        rows["ranges"] = rows["ranges"].filter(lambda ranges: len(ranges) >= 2)
    if cls is Preference:
        rows |= {"width": st.just(3), "height": st.just(2)}
        rows["distance"] = st.lists(st.floats(0, allow_nan=False, width=32), min_size=6, max_size=6)
    if cls is Map:
        rows |= {"poses": st.just(np.zeros((2, 3))), "connected": st.sampled_from([[], [1, 0, 1]])}
    if cls is Belief:
        vector = st.none() | st.lists(st.floats(-1e6, 1e6, width=32), min_size=3, max_size=3)
        rows |= {"xi": vector, "protection": vector, "curvature": st.none() | three.map(lambda m: m.reshape(3, 3))}
    return st.builds(cls, **rows)


def all_messages() -> st.SearchStrategy:
    """Valid messages of any topic, request or reply."""
    classes = [t.message for t in TOPICS] + [c for q in QUERIES for c in (q.request, q.reply)]
    return st.one_of([message_of(cls) for cls in dict.fromkeys(classes)])


def _field(field: FieldInfo) -> st.SearchStrategy:
    return _of(field.annotation, tuple(field.metadata))


def _of(kind: typing.Any, limits: tuple) -> st.SearchStrategy:  # noqa: PLR0911 - one return for each kind of type
    origin = typing.get_origin(kind)
    if origin is typing.Annotated:
        inner, *more = typing.get_args(kind)
        return _of(inner, (*limits, *more))
    for limit in limits:
        if isinstance(limit, Binary):
            return _array(limit)
    if origin is typing.Literal:
        return st.sampled_from(typing.get_args(kind))
    if origin in (typing.Union, types.UnionType):
        return st.one_of([_of(part, limits) for part in typing.get_args(kind)])
    if origin is list:
        return st.lists(_of(typing.get_args(kind)[0], ()), max_size=3)
    if origin is dict:
        key, value = typing.get_args(kind)
        return st.dictionaries(_of(key, ()), _of(value, ()), max_size=3)
    if kind in FIXED:
        return FIXED[kind]
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return message_of(kind)
    return _plain(kind, _limits(limits))


def _plain(kind: typing.Any, limits: dict[str, typing.Any]) -> st.SearchStrategy:
    if kind is bool:
        return st.booleans()
    if kind is type(None):
        return st.none()
    if kind is str:
        return st.text(max_size=min(limits.get("max_length", 10), 10))
    if kind is int:
        return st.integers(limits.get("ge", 0), min(limits.get("lt", 2**63), limits.get("le", 2**63) + 1) - 1)
    if kind is float:
        low = limits.get("gt", limits.get("ge"))
        return st.floats(low, limits.get("le"), exclude_min="gt" in limits, allow_nan=False, allow_infinity=False)
    raise AssertionError(f"no strategy for {kind}: add one, so that the new field is tested")


def _limits(metadata: tuple) -> dict[str, typing.Any]:
    found: dict[str, typing.Any] = {}
    for item in metadata:
        parts = item.metadata if isinstance(item, FieldInfo) else [item]
        for part in parts:
            for name in ("ge", "gt", "le", "lt", "max_length"):
                if isinstance(part, annotated_types.BaseMetadata) and getattr(part, name, None) is not None:
                    found[name] = getattr(part, name)
    return found


@functools.cache
def _array(binary: Binary) -> st.SearchStrategy:
    width = 32 if binary.dtype == "<f4" else 64
    number: st.SearchStrategy = st.integers(0, 255)
    if binary.dtype != "u1":
        limit = binary.largest
        number = (
            st.floats(-limit, limit, width=width)
            if limit
            else st.floats(allow_nan=False, allow_infinity=False, width=width)
        )
        if binary.values == "ranges":
            number |= st.sampled_from([np.inf, -np.inf])
    columns = int(np.prod(binary.row))
    rows = st.integers(0, 20 // columns)
    flat = rows.flatmap(lambda n: st.lists(number, min_size=n * columns, max_size=n * columns))
    return flat.map(lambda values: np.array(values, binary.dtype).reshape(-1, *binary.row))
