"""One browser's web socket."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import TypeVar

from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.utils import ClientDisconnected

from services.viewer import visitor_requests as requests
from services.viewer.control import ActionResult
from services.viewer.request_handler import RequestHandler
from services.viewer.visitors import TooSlowError, Visitor

T = TypeVar("T")
MAX_QUEUED = 32  # actions of one visitor that wait to be carried out
MESSAGES_PER_S, MAX_BURST = 60.0, 120.0  # rate limit per visitor; further messages are read later
CLOSE_CODE_TOO_SLOW = 1008  # web socket close code: policy violation


class VisitorSession:
    """Handles one web socket from its opening to its end."""

    def __init__(self, websocket: WebSocket, handler: RequestHandler) -> None:
        self._websocket, self._handler = websocket, handler
        self._counters = handler.context.hub.counters
        self._visitor = Visitor(_sender(websocket.send_text), _sender(websocket.send_bytes))
        self._queue: asyncio.Queue[tuple[int | None, requests.Action]] = asyncio.Queue(MAX_QUEUED)
        self._allowed, self._allowed_at = MAX_BURST, asyncio.get_running_loop().time()

    async def run(self) -> None:
        """Accepts the socket and serves it until either side closes it."""
        await self._websocket.accept()
        hub = self._handler.context.hub
        tasks = [asyncio.create_task(work()) for work in (self._visitor.run, self._read, self._work)]
        self._handler.show_robot(self._visitor, self._handler.context.roster.robot)
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            hub.remove(self._visitor)
            for task in tasks:
                task.cancel()
            ends = await asyncio.gather(*tasks, return_exceptions=True)
        for end in ends:
            if isinstance(end, TooSlowError):
                self._counters["visitors_disconnected"] += 1
                with suppress(asyncio.TimeoutError, WebSocketDisconnect, ClientDisconnected, RuntimeError):
                    await asyncio.wait_for(self._websocket.close(CLOSE_CODE_TOO_SLOW, "too slow"), 1.0)
            elif isinstance(end, Exception) and not isinstance(end, WebSocketDisconnect | ClientDisconnected):
                raise end

    async def _read(self) -> None:
        while True:
            message = await self._websocket.receive()
            if message["type"] == "websocket.disconnect":
                if message.get("code") in {1007, 1009}:  # invalid UTF-8, or longer than MAX_MESSAGE_BYTES
                    self._counters["malformed"] += 1
                return
            await self._limit_rate()
            text = message.get("text")
            try:
                number, action = requests.parse(text) if text is not None else _refuse_bytes()
            except requests.InvalidRequestError as refused:
                self._counters["malformed"] += 1
                self._answer(refused.number, ActionResult(ok=False, reason=str(refused)))
                continue
            await self._take(number, action)

    async def _take(self, number: int | None, action: requests.Action) -> None:
        if isinstance(action, requests.DriveByHand):  # not queued, so that it does not wait for a slow action
            self._answer(number, await self._handler.act(self._visitor, action))
            return
        try:
            self._queue.put_nowait((number, action))
        except asyncio.QueueFull:
            self._counters["requests_rejected"] += 1
            self._answer(number, ActionResult(ok=False, reason="too many requests are waiting; try again later"))

    async def _work(self) -> None:
        while True:
            number, action = await self._queue.get()
            self._answer(number, await self._handler.act(self._visitor, action))

    def _answer(self, number: int | None, answer: ActionResult) -> None:
        self._counters["answers"] += 1
        self._counters["refused"] += not answer.ok
        message = {"type": "answer", "id": number, "ok": answer.ok, "reason": answer.reason, **answer.more}
        self._visitor.queue_text(json.dumps(message))

    async def _limit_rate(self) -> None:
        """Delays reading if messages exceed the rate limit; TCP's flow control then slows the sender."""
        now = asyncio.get_running_loop().time()
        self._allowed = min(MAX_BURST, self._allowed + (now - self._allowed_at) * MESSAGES_PER_S) - 1.0
        self._allowed_at = now
        if self._allowed < 0:
            await asyncio.sleep(-self._allowed / MESSAGES_PER_S)


def _sender(send: Callable[[T], Awaitable[None]]) -> Callable[[T], Awaitable[None]]:
    """Wraps ``send`` to raise WebSocketDisconnect if the server has already closed the socket (message too long)."""

    async def checked(data: T) -> None:
        try:
            await send(data)
        except RuntimeError as error:  # uvicorn: "... after sending 'websocket.close'"
            raise WebSocketDisconnect(1006, str(error)) from None

    return checked


def _refuse_bytes() -> tuple[int | None, requests.Action]:
    raise requests.InvalidRequestError("text is expected, not bytes")
