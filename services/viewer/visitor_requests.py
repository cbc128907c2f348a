"""Parses what a browser asks for."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from common.errors import first_fault
from common.geometry.world import Obstacle
from common.limits import Angle, Coordinate

MAX_TEXT_CHARS = 4096  # characters; an obstacle of a hundred corners fits

Speed = Annotated[float, Field(allow_inf_nan=False, ge=-100, le=100)]
RobotName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]


class InvalidRequestError(ValueError):
    """A message that asks nothing that can be done; with the ``id`` it had, if any."""

    def __init__(self, reason: str, number: int | None = None) -> None:
        """``reason`` in words a visitor understands."""
        super().__init__(reason)
        self.number = number


class Action(BaseModel):
    """One message of a visitor; fields it does not know are ignored."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")


class Watch(Action):
    """Show that robot."""

    do: Literal["watch"]
    robot: RobotName


class GoTo(Action):
    """Set a goal."""

    do: Literal["goal"]
    x: Coordinate
    y: Coordinate
    yaw: Angle | None = None
    tolerance: Annotated[float, Field(allow_inf_nan=False, gt=0, le=100)] | None = None


class Cancel(Action):
    """Forget the goal."""

    do: Literal["cancel"]


class Teleport(Action):
    """Teleport the robot."""

    do: Literal["teleport"]
    x: Coordinate
    y: Coordinate
    yaw: Angle = 0.0


class Localise(Action):
    """Begin localisation anew, from a place or from nothing."""

    do: Literal["localise"]
    x: Coordinate | None = None
    y: Coordinate | None = None
    yaw: Angle | None = None


class EditObstacle(Action):
    """Change the furniture."""

    do: Literal["obstacle"]
    action: Literal["add", "move", "remove"]
    name: Annotated[str, Field(min_length=1, max_length=200)]
    obstacle: Obstacle | None = None


class ControlClock(Action):
    """Of the simulation."""

    do: Literal["pause", "resume", "step"]


class Reset(Action):
    """Begin the simulation anew."""

    do: Literal["reset"]
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None


class SetSpeed(Action):
    """Times real time."""

    do: Literal["speed"]
    factor: Annotated[float, Field(allow_inf_nan=False, gt=0, le=1000)]


class DriveByHand(Action):
    """Drive by hand, for half a second."""

    do: Literal["drive"]
    vx: Speed = 0.0
    vy: Speed = 0.0
    wz: Speed = 0.0


class Record(Action):
    """Begin or end a recording, or ask how it stands."""

    do: Literal["record"]
    action: Literal["start", "stop", "status"]


class ListRecordings(Action):
    """Which there are."""

    do: Literal["recordings"]


class Open(Action):
    """Show a recording."""

    do: Literal["open"]
    name: Annotated[str, Field(min_length=1, max_length=255)]


class Close(Action):
    """Show it no more."""

    do: Literal["close"]


class ControlPlayer(Action):
    """Control the open recording."""

    do: Literal["player"]
    action: Literal["pause", "resume", "step", "seek", "rate", "status"]
    value: Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)] | None = None


KINDS = (
    Watch, GoTo, Cancel, Teleport, Localise, EditObstacle, ControlClock, Reset, SetSpeed, DriveByHand, Record, ListRecordings, Open, Close, ControlPlayer,
)  # fmt: skip
_BY_NAME: dict[str, TypeAdapter[Any]] = {
    name: TypeAdapter(kind) for kind in KINDS for name in kind.model_fields["do"].annotation.__args__  # type: ignore[union-attr]
}  # fmt: skip


def parse(text: str) -> tuple[int | None, Action]:
    """The message's id and what it asks; raises InvalidRequestError, and nothing else, whatever the text is."""
    if len(text) > MAX_TEXT_CHARS:
        raise InvalidRequestError(f"a message of {len(text)} characters is too long: {MAX_TEXT_CHARS} are read")
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):  # a number of 5000 digits, 4000 brackets
        raise InvalidRequestError("this is no JSON") from None
    if not isinstance(data, dict):
        raise InvalidRequestError('a JSON object is expected, such as {"id": 1, "do": "cancel"}')
    number = data.get("id")
    if isinstance(number, bool) or not isinstance(number, int) or abs(number) > 2**53:
        number = None
    name = data.get("do")
    adapter = _BY_NAME.get(name) if isinstance(name, str) else None
    if adapter is None:
        raise InvalidRequestError(f"nothing is done by that name; there are: {', '.join(_BY_NAME)}", number)
    try:
        action: Action = adapter.validate_python(data)
    except ValidationError as error:
        raise InvalidRequestError(first_fault(error)[:500], number) from None
    except Exception as error:  # noqa: BLE001 - whatever a hostile number does inside shapely
        raise InvalidRequestError(f"this makes no sense ({type(error).__name__})", number) from None
    return number, action
