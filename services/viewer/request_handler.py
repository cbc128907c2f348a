"""Carries out browsers' requests, and sends them the world, robots and recordings.

Runs in the web server's event loop. Calls that block, on the bus or on a child process, run in a thread pool.
"""

from __future__ import annotations

import asyncio
import functools
import json
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from common.errors import UserError
from common.messages.requests import ModelReply, ModelRequest, PlayerReply, PlayerRequest, Request, WorldReply
from common.messages.topics import MODEL, PLAYER, WORLD
from services.viewer import visitor_requests as requests
from services.viewer.control import ActionResult, RobotControl
from services.viewer.playback import Playback
from services.viewer.state.roster import Roster
from services.viewer.visitors import Hub, Visitor

WORLD_PERIOD_S = 5.0  # how often the world is queried, because other programs may change it too
MIN_WORLD_PERIOD_S = 0.1  # between two queries, e.g. while a visitor drags an obstacle
PLAYER_PERIOD_S = 0.2  # how often the player's state is queried
UNWATCHED_TIMEOUT_S = 60.0  # a recording without visitors is closed after this
END_MARGIN_S = 0.05  # this close to the end of a recording, "resume" restarts it from the beginning

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class RequestContext:
    """The objects that requests act on."""

    hub: Hub
    control: RobotControl
    playback: Playback
    roster: Roster
    pool: Executor
    control_allowed: bool
    version: str
    on_new_recording: Callable[[str], None]  # called with a robot's name when another recording replaces its messages


class RequestHandler:
    """Handles the requests of all visitors."""

    def __init__(self, context: RequestContext) -> None:
        self.context = context
        self.worlds: dict[str, WorldReply] = {}  # by robot
        self._world_texts: dict[str, str] = {}  # by robot; the worlds as JSON messages for visitors
        self._stale: set[str] = set()  # robots whose world has to be queried again
        self._refresh = asyncio.Event()

    # ---- one visitor

    def show_robot(self, visitor: Visitor, robot: str) -> None:
        """Makes the visitor watch a robot, and sends the list of robots and the robot's world."""
        context = self.context
        context.hub.watch(visitor, robot)
        if robot != context.playback.robot:
            visitor.live_robot = robot
        self._hello(visitor)
        if robot in self._world_texts:
            visitor.queue_text(self._world_texts[robot], "world")
        else:
            self.refresh_world(robot)

    async def act(self, visitor: Visitor, action: requests.Action) -> ActionResult:  # noqa: PLR0911 - one per action
        """Carries out a visitor's action. Returns the reason if that fails."""
        if not self.context.control_allowed and not isinstance(action, requests.WatchRobot):
            return ActionResult(ok=False, reason="visitors of this page only watch (it runs without --allow-control)")
        try:
            match action:
                case requests.WatchRobot():
                    return self._watch(visitor, action.robot)
                case requests.ListRecordings():
                    return await self._recordings()
                case requests.OpenRecordingFile():
                    return await self._open(visitor, action.name)
                case requests.CloseRecordingFile():
                    return await self._close()
                case requests.ControlPlayer():
                    return await self._in_thread(self._play, action)
                case _:
                    return await self._on_robot(visitor.robot, action)
        except UserError as error:
            return ActionResult(ok=False, reason=str(error))

    async def _on_robot(self, robot: str, action: requests.Action) -> ActionResult:
        answer = await self._in_thread(self.context.control.carry_out, robot, action)
        if answer.ok and isinstance(action, requests.EditObstacle | requests.ResetSimulation):
            self.refresh_world(robot)
        return answer

    def _hello(self, visitor: Visitor) -> None:
        context = self.context
        robots = context.roster.robots()
        if visitor.robot not in robots:
            robots.append(visitor.robot)
        hello = {
            "type": "hello",
            "control": context.control_allowed,
            "version": context.version,
            "robots": robots,
            "robot": visitor.robot,
        }
        visitor.queue_text(json.dumps(hello), "hello")

    def _watch(self, visitor: Visitor, robot: str) -> ActionResult:
        robots = self.context.roster.robots()
        if robot not in robots:
            raise UserError(f"no robot {robot!r}: there are {', '.join(robots)}")
        self.show_robot(visitor, robot)
        return ActionResult(ok=True, reason=f"watching {robot}")

    async def _recordings(self) -> ActionResult:
        files = await self._in_thread(self.context.playback.files)
        folder = self.context.playback.folder
        return ActionResult(ok=True, reason="" if files else f"no recordings in {folder}", more={"files": files})

    async def _open(self, visitor: Visitor, name: str) -> ActionResult:
        context, robot = self.context, self.context.playback.robot
        await self._in_thread(context.playback.check, name)
        try:
            await self._in_thread(context.playback.open, name, lambda: "replay" in context.roster.services(robot))
        finally:  # the recording that was open before is closed even if this one cannot be opened
            self._forget_world(robot)
            context.on_new_recording(robot)
            if not context.playback.name:
                self._on_closed()
        for other in {visitor, *context.hub.watching(robot)}:
            self.show_robot(other, robot)
        await self._in_thread(self._show_position)
        return ActionResult(ok=True, reason=name)

    async def _close(self) -> ActionResult:
        if not self.context.playback.name:
            raise UserError("no recording is open")
        await self._in_thread(self.context.playback.close)
        self._on_closed()
        return ActionResult(ok=True, reason="closed")

    # ---- the open recording; these methods run in a thread

    def _play(self, action: requests.ControlPlayer) -> ActionResult:
        if not self.context.playback.name:
            raise UserError("no recording is open")
        if action.action in {"seek", "rate"} and action.value is None:
            raise UserError(f"{action.action} needs a value")
        if action.action == "resume":
            state = self._player("status")
            if state.position_s >= state.duration_s - END_MARGIN_S:
                self._player("seek", 0.0)
        state = self._player(action.action, action.value or 0.0)
        if action.action == "seek" and state.paused:
            self._show_position()
        return ActionResult(ok=True)

    def _show_position(self) -> None:
        """Plays two steps of a paused recording, so that the page shows a scan together with its belief and command."""
        self._player("step", 2)

    def _player(self, action: Any, value: float = 0.0) -> PlayerReply:
        request = PlayerRequest(action=action, value=value)
        return self.context.control.send_request(self.context.playback.robot, PLAYER, request, PlayerReply)

    # ---- all visitors

    def refresh_world(self, robot: str) -> None:
        """Requests that the robot's world is queried again soon."""
        self._stale.add(robot)
        self._refresh.set()

    def robots_changed(self, changed: frozenset[str]) -> None:
        """Sends the new list of robots, after services of these robots came or went."""
        for visitor in self.context.hub.all_visitors():
            self._hello(visitor)
        for robot in changed & self.context.hub.watched:
            self.refresh_world(robot)

    async def run(self) -> None:
        """Follows worlds and the player until cancelled."""
        await asyncio.gather(self._follow_worlds(), self._follow_player())

    async def _follow_worlds(self) -> None:
        clock = asyncio.get_running_loop().time
        queried_at: dict[str, float] = {}
        while True:
            for robot in self.context.hub.watched:
                if robot in self._stale or clock() - queried_at.get(robot, -WORLD_PERIOD_S) >= WORLD_PERIOD_S:
                    self._stale.discard(robot)
                    queried_at[robot] = clock()
                    await self._query_world(robot)
            await asyncio.sleep(MIN_WORLD_PERIOD_S)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._refresh.wait(), 1.0)
            self._refresh.clear()

    async def _query_world(self, robot: str) -> None:
        """Queries the robot's world and sends it to visitors if it has changed."""
        try:
            reply = await self._in_thread(self._world_of, robot)
        except UserError:
            return  # the next query may succeed
        if reply is None or reply == self.worlds.get(robot):
            return
        self.worlds[robot] = reply
        parts = {"world": reply.world, "scanner": reply.scanner, "robot": reply.robot}
        plain = {name: part.model_dump(mode="json") if part is not None else None for name, part in parts.items()}
        self._world_texts[robot] = json.dumps({"type": "world", **plain})
        self.context.hub.queue_text(robot, "world", self._world_texts[robot])

    def _forget_world(self, robot: str) -> None:
        self.worlds.pop(robot, None)
        self._world_texts.pop(robot, None)

    def _world_of(self, robot: str) -> WorldReply | None:
        """The world of the simulator or of the recording, else the estimator's map; None if there is none yet."""
        query, services = self.context.control.query, self.context.roster.services(robot)
        if services & {"simulator", "replay"}:
            reply = query(robot, WORLD, Request(), WorldReply)
            if reply.ok or "estimator" not in services:
                return reply
        elif "estimator" not in services:
            return None
        world = query(robot, MODEL, ModelRequest(), ModelReply).world
        return None if world is None else WorldReply(world=world)

    async def _follow_player(self) -> None:
        playback, hub = self.context.playback, self.context.hub
        unwatched_s = 0.0
        while True:
            await asyncio.sleep(PLAYER_PERIOD_S)
            unwatched_s = 0.0 if not playback.name or hub.watching(playback.robot) else unwatched_s + PLAYER_PERIOD_S
            if not playback.name:
                continue
            if (error := await self._in_thread(playback.ended)) is not None:
                self._on_closed(error)
            elif unwatched_s > UNWATCHED_TIMEOUT_S:
                await self._in_thread(playback.close)
            elif unwatched_s == 0.0:
                with suppress(UserError):
                    state = await self._in_thread(self._player, "status")
                    text = json.dumps({"type": "player", **state.model_dump(mode="json"), "file": playback.name})
                    hub.queue_text(playback.robot, "player", text)

    def _on_closed(self, reason: str = "") -> None:
        """Shows visitors who watched the recording the robot again that they watched before."""
        playback, hub = self.context.playback, self.context.hub
        self._forget_world(playback.robot)
        for visitor in hub.watching(playback.robot):
            self.show_robot(visitor, visitor.live_robot or self.context.roster.robot)
            visitor.queue_text(json.dumps({"type": "closed", "reason": reason}))

    async def _in_thread(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        call = functools.partial(work, *args, **kwargs)
        return await asyncio.get_running_loop().run_in_executor(self.context.pool, call)
