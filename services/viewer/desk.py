"""Carries out browsers' requests, and sends them the world, robots and recordings.

Runs in the web server's loop; whatever waits for the bus or for a child does so in a thread of the pool.
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
from common.messages.requests import PlayerReply, PlayerRequest, Request, WorldReply
from common.messages.topics import PLAYER, WORLD
from services.viewer import visitor_requests as requests
from services.viewer.control import ActionResult, Control
from services.viewer.playback import Playback
from services.viewer.state.roster import Roster
from services.viewer.visitors import Hub, Visitor

WORLD_PERIOD_S = 5.0  # s; others may change it too
MIN_WORLD_PERIOD_S = 0.1  # s between two questions, however fast somebody drags an obstacle
PLAYER_PERIOD_S = 0.2  # s
UNWATCHED_TIMEOUT_S = 60.0  # s without anybody who watches it, then a recording is closed
END_MARGIN_S = 0.05  # s before a recording's end from which play begins anew

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class DeskContext:
    """What the desk works with."""

    hub: Hub
    control: Control
    playback: Playback
    roster: Roster
    pool: Executor
    control_allowed: bool
    version: str
    on_new_recording: Callable[[str], None]  # another recording under a robot's name: what was heard of it is no more


class Desk:
    """One for all visitors."""

    def __init__(self, context: DeskContext) -> None:
        """Nothing is known yet."""
        self.context = context
        self.worlds: dict[str, WorldReply] = {}  # by robot
        self._texts: dict[str, str] = {}  # the same for visitors
        self._stale: set[str] = set()
        self._ask = asyncio.Event()

    # ---- one visitor

    def show_robot(self, visitor: Visitor, robot: str) -> None:
        """Show a robot from now on."""
        context = self.context
        context.hub.watch(visitor, robot)
        self._hello(visitor)
        if robot in self._texts:
            visitor.queue_text(self._texts[robot], "world")
        else:
            self.refresh_world(robot)

    async def act(self, visitor: Visitor, action: requests.Action) -> ActionResult:  # noqa: PLR0911 - one a kind
        """Done, or why not."""
        if not self.context.control_allowed and not isinstance(action, requests.Watch):
            return ActionResult(ok=False, reason="visitors of this page only watch (it runs without --allow-control)")
        try:
            match action:
                case requests.Watch():
                    return self._watch(visitor, action.robot)
                case requests.ListRecordings():
                    return await self._recordings()
                case requests.Open():
                    return await self._open(visitor, action.name)
                case requests.Close():
                    return await self._close()
                case requests.ControlPlayer():
                    return await self._in_thread(self._play, action)
                case _:
                    return await self._on_robot(visitor.robot, action)
        except UserError as error:
            return ActionResult(ok=False, reason=str(error))

    async def _on_robot(self, robot: str, action: requests.Action) -> ActionResult:
        answer = await self._in_thread(self.context.control.do, robot, action)
        if answer.ok and isinstance(action, requests.EditObstacle | requests.Reset):
            self.refresh_world(robot)
        return answer

    def _hello(self, visitor: Visitor) -> None:
        context = self.context
        robots = context.roster.robots()
        if visitor.robot not in robots:
            robots.append(visitor.robot)
        hello = {
            "control": context.control_allowed,
            "version": context.version,
            "robots": robots,
            "robot": visitor.robot,
        }
        visitor.queue_text(json.dumps({"type": "hello", **hello}), "hello")

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
        try:
            await self._in_thread(
                context.playback.open, name, lambda: "replay" in context.roster.services(robot)
            )  # fmt: skip
        finally:  # the one open before is closed, whatever comes of this
            self.worlds.pop(robot, None)
            self._texts.pop(robot, None)
            context.on_new_recording(robot)
            if not context.playback.name:
                self._closed("")
        for other in {visitor, *context.hub.watching(robot)}:
            self.show_robot(other, robot)
        await self._in_thread(self._show_place)
        return ActionResult(ok=True, reason=name)

    async def _close(self) -> ActionResult:
        if not self.context.playback.name:
            raise UserError("no recording is open")
        await self._in_thread(self.context.playback.close)
        self._closed("")
        return ActionResult(ok=True, reason="closed")

    # ---- the recording; in a thread

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
            self._show_place()
        return ActionResult(ok=True)

    def _show_place(self) -> None:
        """A frame of where it stands, paused: a scan, and with the second step what answered it."""
        self._player("step", 2)

    def _player(self, action: Any, value: float = 0.0) -> PlayerReply:
        request = PlayerRequest(action=action, value=value)
        return self.context.control.ask(self.context.playback.robot, PLAYER, request, PlayerReply)

    # ---- all visitors

    def refresh_world(self, robot: str) -> None:
        """The robot's world may be another."""
        self._stale.add(robot)
        self._ask.set()

    def robots_changed(self, changed: frozenset[str]) -> None:
        """Services of these came or went."""
        for visitor in self.context.hub.all_visitors():
            self._hello(visitor)
        for robot in changed & self.context.hub.watched:
            self.refresh_world(robot)

    async def run(self) -> None:
        """Until cancelled."""
        await asyncio.gather(self._follow_worlds(), self._follow_player())

    async def _follow_worlds(self) -> None:
        clock = asyncio.get_running_loop().time
        asked: dict[str, float] = {}
        while True:
            for robot in self.context.hub.watched:
                if robot in self._stale or clock() - asked.get(robot, -WORLD_PERIOD_S) >= WORLD_PERIOD_S:
                    self._stale.discard(robot)
                    asked[robot] = clock()
                    await self._look(robot)
            await asyncio.sleep(MIN_WORLD_PERIOD_S)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._ask.wait(), 1.0)
            self._ask.clear()

    async def _look(self, robot: str) -> None:
        """Ask for the world, and tell if it is another."""
        services = self.context.roster.services(robot)
        if not services & {"simulator", "replay"}:
            return
        try:
            reply = await self._in_thread(
                self.context.control.query, robot, WORLD, Request(), WorldReply
            )  # fmt: skip
        except UserError:
            return  # it is asked again
        if reply == self.worlds.get(robot):
            return
        self.worlds[robot] = reply
        parts = {"world": reply.world, "scanner": reply.scanner, "robot": reply.robot}
        plain = {name: part.model_dump(mode="json") if part is not None else None for name, part in parts.items()}
        self._texts[robot] = json.dumps({"type": "world", **plain})
        self.context.hub.queue_text(robot, "world", self._texts[robot])

    async def _follow_player(self) -> None:
        playback, hub = self.context.playback, self.context.hub
        alone = 0.0  # s without anybody who watches
        while True:
            await asyncio.sleep(PLAYER_PERIOD_S)
            alone = 0.0 if not playback.name or hub.watching(playback.robot) else alone + PLAYER_PERIOD_S
            if not playback.name:
                continue
            if (complaint := await self._in_thread(playback.ended)) is not None:
                self._closed(complaint)
            elif alone > UNWATCHED_TIMEOUT_S:
                await self._in_thread(playback.close)
            elif alone == 0.0:
                with suppress(UserError):
                    state = await self._in_thread(self._player, "status")
                    said = json.dumps({"type": "player", **state.model_dump(mode="json"), "file": playback.name})
                    hub.queue_text(playback.robot, "player", said)

    def _closed(self, reason: str) -> None:
        """Who watched the recording sees our robot again."""
        playback, hub = self.context.playback, self.context.hub
        self.worlds.pop(playback.robot, None)
        self._texts.pop(playback.robot, None)
        for visitor in hub.watching(playback.robot):
            self.show_robot(visitor, self.context.roster.robot)
            visitor.queue_text(json.dumps({"type": "closed", "reason": reason}))

    async def _in_thread(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        call = functools.partial(work, *args, **kwargs)
        return await asyncio.get_running_loop().run_in_executor(self.context.pool, call)
