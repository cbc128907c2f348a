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
from services.viewer import visitor_requests as a
from services.viewer.control import Answer, Control
from services.viewer.playback import Playback
from services.viewer.state.roster import Roster
from services.viewer.visitors import Hub, Visitor

WORLD_PERIOD = 5.0  # s; others may change it too
WORLD_PAUSE = 0.1  # s between two questions, however fast somebody drags an obstacle
PLAYER_PERIOD = 0.2  # s
FORGOTTEN = 60.0  # s without anybody who watches it, then a recording is closed
AT_END = 0.05  # s before a recording's end from which play begins anew

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Office:
    """What the desk works with."""

    hub: Hub
    control: Control
    playback: Playback
    roster: Roster
    pool: Executor
    may_act: bool
    version: str
    renew: Callable[[str], None]  # another recording under a robot's name: what was heard of it is no more


class Desk:
    """One for all visitors."""

    def __init__(self, office: Office) -> None:
        """Nothing is known yet."""
        self.office = office
        self.worlds: dict[str, WorldReply] = {}  # by robot
        self._texts: dict[str, str] = {}  # the same for visitors
        self._stale: set[str] = set()
        self._ask = asyncio.Event()

    # ---- one visitor

    def greet(self, visitor: Visitor, robot: str) -> None:
        """Show a robot from now on."""
        office = self.office
        office.hub.watch(visitor, robot)
        self._hello(visitor)
        if robot in self._texts:
            visitor.say(self._texts[robot], "world")
        else:
            self.look_again(robot)

    async def act(self, visitor: Visitor, action: a.Action) -> Answer:  # noqa: PLR0911 - one a kind
        """Done, or why not."""
        if not self.office.may_act and not isinstance(action, a.Watch):
            return Answer(ok=False, reason="visitors of this page only watch (it runs without --allow-control)")
        try:
            match action:
                case a.Watch():
                    return self._watch(visitor, action.robot)
                case a.Recordings():
                    return await self._recordings()
                case a.Open():
                    return await self._open(visitor, action.name)
                case a.Close():
                    return await self._close()
                case a.Play():
                    return await self._in_thread(self._play, action)
                case _:
                    return await self._on_robot(visitor.robot, action)
        except UserError as error:
            return Answer(ok=False, reason=str(error))

    async def _on_robot(self, robot: str, action: a.Action) -> Answer:
        answer = await self._in_thread(self.office.control.do, robot, action)
        if answer.ok and isinstance(action, a.Furnish | a.Reset):
            self.look_again(robot)
        return answer

    def _hello(self, visitor: Visitor) -> None:
        office = self.office
        robots = office.roster.robots()
        if visitor.robot not in robots:
            robots.append(visitor.robot)
        hello = {"control": office.may_act, "version": office.version, "robots": robots, "robot": visitor.robot}
        visitor.say(json.dumps({"type": "hello", **hello}), "hello")

    def _watch(self, visitor: Visitor, robot: str) -> Answer:
        robots = self.office.roster.robots()
        if robot not in robots:
            raise UserError(f"no robot {robot!r}: there are {', '.join(robots)}")
        self.greet(visitor, robot)
        return Answer(ok=True, reason=f"watching {robot}")

    async def _recordings(self) -> Answer:
        files = await self._in_thread(self.office.playback.files)
        folder = self.office.playback.folder
        return Answer(ok=True, reason="" if files else f"no recordings in {folder}", more={"files": files})

    async def _open(self, visitor: Visitor, name: str) -> Answer:
        office, robot = self.office, self.office.playback.robot
        try:
            await self._in_thread(
                office.playback.open, name, lambda: "replay" in office.roster.services(robot)
            )  # fmt: skip
        finally:  # the one open before is closed, whatever comes of this
            self.worlds.pop(robot, None)
            self._texts.pop(robot, None)
            office.renew(robot)
            if not office.playback.name:
                self._closed("")
        for other in {visitor, *office.hub.of(robot)}:
            self.greet(other, robot)
        await self._in_thread(self._show_place)
        return Answer(ok=True, reason=name)

    async def _close(self) -> Answer:
        if not self.office.playback.name:
            raise UserError("no recording is open")
        await self._in_thread(self.office.playback.close)
        self._closed("")
        return Answer(ok=True, reason="closed")

    # ---- the recording; in a thread

    def _play(self, action: a.Play) -> Answer:
        if not self.office.playback.name:
            raise UserError("no recording is open")
        if action.action in {"seek", "rate"} and action.value is None:
            raise UserError(f"{action.action} needs a value")
        if action.action == "resume":
            state = self._player("status")
            if state.position_s >= state.duration_s - AT_END:
                self._player("seek", 0.0)
        state = self._player(action.action, action.value or 0.0)
        if action.action == "seek" and state.paused:
            self._show_place()
        return Answer(ok=True)

    def _show_place(self) -> None:
        """A frame of where it stands, paused: a scan, and with the second step what answered it."""
        self._player("step", 2)

    def _player(self, action: Any, value: float = 0.0) -> PlayerReply:
        request = PlayerRequest(action=action, value=value)
        return self.office.control.ask(self.office.playback.robot, PLAYER, request, PlayerReply)

    # ---- all visitors

    def look_again(self, robot: str) -> None:
        """The robot's world may be another."""
        self._stale.add(robot)
        self._ask.set()

    def robots_changed(self, changed: frozenset[str]) -> None:
        """Services of these came or went."""
        for visitor in self.office.hub.everybody():
            self._hello(visitor)
        for robot in changed & self.office.hub.watched:
            self.look_again(robot)

    async def run(self) -> None:
        """Until cancelled."""
        await asyncio.gather(self._follow_worlds(), self._follow_player())

    async def _follow_worlds(self) -> None:
        clock = asyncio.get_running_loop().time
        asked: dict[str, float] = {}
        while True:
            for robot in self.office.hub.watched:
                if robot in self._stale or clock() - asked.get(robot, -WORLD_PERIOD) >= WORLD_PERIOD:
                    self._stale.discard(robot)
                    asked[robot] = clock()
                    await self._look(robot)
            await asyncio.sleep(WORLD_PAUSE)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._ask.wait(), 1.0)
            self._ask.clear()

    async def _look(self, robot: str) -> None:
        """Ask for the world, and tell if it is another."""
        services = self.office.roster.services(robot)
        if not services & {"simulator", "replay"}:
            return
        try:
            reply = await self._in_thread(
                self.office.control.tolerant_ask, robot, WORLD, Request(), WorldReply
            )  # fmt: skip
        except UserError:
            return  # it is asked again
        if reply == self.worlds.get(robot):
            return
        self.worlds[robot] = reply
        parts = {"world": reply.world, "scanner": reply.scanner, "robot": reply.robot}
        plain = {name: part.model_dump(mode="json") if part is not None else None for name, part in parts.items()}
        self._texts[robot] = json.dumps({"type": "world", **plain})
        self.office.hub.tell(robot, "world", self._texts[robot])

    async def _follow_player(self) -> None:
        playback, hub = self.office.playback, self.office.hub
        alone = 0.0  # s without anybody who watches
        while True:
            await asyncio.sleep(PLAYER_PERIOD)
            alone = 0.0 if not playback.name or hub.of(playback.robot) else alone + PLAYER_PERIOD
            if not playback.name:
                continue
            if (complaint := await self._in_thread(playback.ended)) is not None:
                self._closed(complaint)
            elif alone > FORGOTTEN:
                await self._in_thread(playback.close)
            elif alone == 0.0:
                with suppress(UserError):
                    state = await self._in_thread(self._player, "status")
                    said = json.dumps({"type": "player", **state.model_dump(mode="json"), "file": playback.name})
                    hub.tell(playback.robot, "player", said)

    def _closed(self, reason: str) -> None:
        """Who watched the recording sees our robot again."""
        playback, hub = self.office.playback, self.office.hub
        self.worlds.pop(playback.robot, None)
        self._texts.pop(playback.robot, None)
        for visitor in hub.of(playback.robot):
            self.greet(visitor, self.office.roster.robot)
            visitor.say(json.dumps({"type": "closed", "reason": reason}))

    async def _in_thread(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        call = functools.partial(work, *args, **kwargs)
        return await asyncio.get_running_loop().run_in_executor(self.office.pool, call)
