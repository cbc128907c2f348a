"""The end of a socket: a lost connection is no error, but a failing action is."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest
from starlette.websockets import WebSocket

from services.viewer.visitor_session import VisitorSession
from services.viewer.visitors import Hub


def talk(send, messages, act=None):
    """Runs a session that receives ``messages`` and then nothing more."""
    coming = iter([{"type": "websocket.connect"}, *messages])

    async def receive():
        for message in coming:
            return message
        return await asyncio.Event().wait()

    async def whole():
        context = SimpleNamespace(hub=Hub(), roster=SimpleNamespace(robot="robot"))
        desk = SimpleNamespace(context=context, act=act, show_robot=lambda visitor, _robot: visitor.queue_text("hello"))
        websocket = WebSocket({"type": "websocket"}, receive, send)
        await asyncio.wait_for(VisitorSession(websocket, desk).run(), 30.0)

    asyncio.run(whole())


def test_closed_socket():
    async def send(message):
        if message["type"] == "websocket.send":  # as uvicorn raises it after a message that was too long
            raise RuntimeError("Unexpected ASGI message 'websocket.send', after sending 'websocket.close'.")

    talk(send, [])


def test_error_of_an_action():
    async def send(_message):
        pass

    async def act(_visitor, _action):
        raise RuntimeError("ours")

    with pytest.raises(RuntimeError, match="ours"):
        talk(send, [{"type": "websocket.receive", "text": '{"id": 1, "do": "recordings"}'}], act)
