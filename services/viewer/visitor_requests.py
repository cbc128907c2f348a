"""Parses requests from browsers."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from common.errors import first_fault
from common.geometry.world import Obstacle
from common.limits import Angle, Coordinate
from common.messages.topics import ROBOT_NAME_PATTERN

MAX_TEXT_CHARS = 4096  # enough for an obstacle with a hundred corners

Speed = Annotated[float, Field(allow_inf_nan=False, ge=-100, le=100)]
RobotName = Annotated[str, Field(pattern=rf"^{ROBOT_NAME_PATTERN}$")]


class InvalidRequestError(ValueError):
    """An invalid message from a browser."""

    def __init__(self, reason: str, number: int | None = None) -> None:
        """``reason`` is shown to the visitor; ``number`` is the message's ``id``, if it has one."""
        super().__init__(reason)
        self.number = number


class Action(BaseModel):
    """One request of a visitor. Unknown fields are ignored."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")


class WatchRobot(Action):
    """Show another robot."""

    do: Literal["watch"]
    robot: RobotName


class GoTo(Action):
    """Set a goal."""

    do: Literal["goal"]
    x: Coordinate
    y: Coordinate
    yaw: Angle | None = None
    tolerance: Annotated[float, Field(allow_inf_nan=False, gt=0, le=100)] | None = None


class CancelGoal(Action):
    """Cancel the goal."""

    do: Literal["cancel"]


class Explore(Action):
    """Explore the unknown space around the map, and return."""

    do: Literal["explore"]


class Teleport(Action):
    """Teleport the robot."""

    do: Literal["teleport"]
    x: Coordinate
    y: Coordinate
    yaw: Angle = 0.0


class Localise(Action):
    """Restart localisation, near a pose or on the whole map."""

    do: Literal["localise"]
    x: Coordinate | None = None
    y: Coordinate | None = None
    yaw: Angle | None = None


class EditObstacle(Action):
    """Add, move or remove an obstacle."""

    do: Literal["obstacle"]
    action: Literal["add", "move", "remove"]
    name: Annotated[str, Field(min_length=1, max_length=200)]
    obstacle: Obstacle | None = None


class ControlClock(Action):
    """Pause, resume or step the simulation."""

    do: Literal["pause", "resume", "step"]


class ResetSimulation(Action):
    """Restart the simulation."""

    do: Literal["reset"]
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None


class SetSpeed(Action):
    """Set the simulation's speed as a multiple of real time."""

    do: Literal["speed"]
    factor: Annotated[float, Field(allow_inf_nan=False, gt=0, le=1000)]


class DriveByHand(Action):
    """Drive by hand, for half a second."""

    do: Literal["drive"]
    vx: Speed = 0.0
    vy: Speed = 0.0
    wz: Speed = 0.0


class ControlRecorder(Action):
    """Start or stop a recording, or query its state."""

    do: Literal["record"]
    action: Literal["start", "stop", "status"]


class SaveMap(Action):
    """Save the map that the mapper has built."""

    do: Literal["save_map"]
    name: Annotated[str, Field(max_length=64)]


class ListRecordings(Action):
    """List the recordings."""

    do: Literal["recordings"]


class OpenRecordingFile(Action):
    """Open a recording."""

    do: Literal["open"]
    name: Annotated[str, Field(min_length=1, max_length=255)]


class CloseRecordingFile(Action):
    """Close the open recording."""

    do: Literal["close"]


class ControlPlayer(Action):
    """Control the open recording."""

    do: Literal["player"]
    action: Literal["pause", "resume", "step", "seek", "rate", "status"]
    value: Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)] | None = None


ACTIONS = (
    WatchRobot,
    GoTo,
    CancelGoal,
    Explore,
    Teleport,
    Localise,
    EditObstacle,
    ControlClock,
    ResetSimulation,
    SetSpeed,
    DriveByHand,
    ControlRecorder,
    SaveMap,
    ListRecordings,
    OpenRecordingFile,
    CloseRecordingFile,
    ControlPlayer,
)
# By the names that the field ``do`` may have.
_ADAPTERS: dict[str, TypeAdapter[Any]] = {
    name: TypeAdapter(action)
    for action in ACTIONS
    for name in action.model_fields["do"].annotation.__args__  # type: ignore[union-attr]
}


def parse(text: str) -> tuple[int | None, Action]:
    """Returns the message's id and action. Raises InvalidRequestError, and nothing else, for any invalid text."""
    if len(text) > MAX_TEXT_CHARS:
        raise InvalidRequestError(f"a message of {len(text)} characters is too long: {MAX_TEXT_CHARS} are read")
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):  # also raised for a number of 5000 digits or for 4000 brackets
        raise InvalidRequestError("the message is not valid JSON") from None
    if not isinstance(data, dict):
        raise InvalidRequestError('a JSON object is expected, such as {"id": 1, "do": "cancel"}')
    number = data.get("id")
    if isinstance(number, bool) or not isinstance(number, int) or abs(number) > 2**53:
        number = None
    name = data.get("do")
    adapter = _ADAPTERS.get(name) if isinstance(name, str) else None
    if adapter is None:
        raise InvalidRequestError(f"unknown action; the actions are: {', '.join(_ADAPTERS)}", number)
    try:
        action: Action = adapter.validate_python(data)
    except ValidationError as error:
        raise InvalidRequestError(first_fault(error)[:500], number) from None
    except Exception as error:  # noqa: BLE001 - extreme numbers can raise any error inside shapely
        raise InvalidRequestError(f"invalid values ({type(error).__name__})", number) from None
    return number, action
