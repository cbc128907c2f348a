"""The web server: files, web socket, access."""

from __future__ import annotations

import asyncio
import errno
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.responses import PlainTextResponse
from starlette.routing import Mount, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from common.bus.bus import wait_until
from common.errors import UserError
from services.viewer.access import COOKIE, is_token, known_host, same_origin, token_of
from services.viewer.request_handler import RequestHandler
from services.viewer.settings import FIRST_PORT, ViewerSettings
from services.viewer.visitor_session import VisitorSession

PAGE_FOLDER = Path(__file__).resolve().parent / "static"
MAX_VISITORS = 100
MAX_MESSAGE_BYTES = 1 << 16  # a longer message from a browser closes its connection
SEND_BUFFER_BYTES = 1 << 15  # kernel buffer per visitor; small, so that a slow visitor does not see old frames
TCP_TIMEOUT_MS = 30_000  # unacknowledged data closes a connection after this
PORTS_TO_TRY = 20  # starting with FIRST_PORT
CONTENT_SECURITY_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
SECURITY_HEADERS = {
    "content-security-policy": CONTENT_SECURITY_POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-cache",
}


@dataclass(frozen=True)
class AccessMiddleware:
    """Admits requests by token, host and origin, and adds security headers to responses."""

    app: ASGIApp
    token: str

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on to the application, or refuses it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if scope["type"] == "websocket":
            if refusal is None:
                await self.app(scope, receive, send)
            else:
                await WebSocket(scope, receive, send).send_denial_response(refusal)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(SECURITY_HEADERS)
                if self.token and refusal is None:
                    headers.append("set-cookie", f"{COOKIE}={self.token}; HttpOnly; SameSite=Lax; Path=/")
            await send(message)

        await (refusal or self.app)(scope, receive, with_headers)

    def _refusal(self, scope: Scope) -> PlainTextResponse | None:
        headers = Headers(scope=scope)
        host = headers.get("host")
        if self.token:
            given = token_of(headers.get("cookie"), scope["query_string"].decode("latin-1"))
            if not is_token(given, self.token):
                return PlainTextResponse("a token is needed: open the link with ?token=... that was printed\n", 401)
        elif not known_host(host, {socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}):
            return PlainTextResponse(
                "a token is needed under this host name: use the machine's IP address, or start with --token\n", 403
            )
        if scope["type"] == "websocket" and not same_origin(headers.get("origin"), host):
            return PlainTextResponse("only this server's own page may connect\n", 403)
        return None


class UnbufferedWebSocketProtocol(WebSocketsSansIOProtocol):
    """Blocks a send until the kernel has taken the data, so that a slow visitor gets the newest frame next."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Disables the transport's write buffer."""
        super().connection_made(transport)
        if isinstance(transport, asyncio.WriteTransport):
            transport.set_write_buffer_limits(high=0)


def create_app(handler: RequestHandler, token: str, started: Callable[[asyncio.AbstractEventLoop], None]) -> Starlette:
    """Returns the web application. Calls ``started`` with its event loop."""

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        started(asyncio.get_running_loop())
        work = asyncio.create_task(handler.run())
        yield
        work.cancel()
        with suppress(asyncio.CancelledError):
            await work

    async def connect(websocket: WebSocket) -> None:
        if len(handler.context.hub) >= MAX_VISITORS:
            await websocket.send_denial_response(PlainTextResponse("too many visitors\n", 503))
            return
        await VisitorSession(websocket, handler).run()

    routes = [WebSocketRoute("/ws", connect), Mount("/", StaticFiles(directory=PAGE_FOLDER, html=True))]
    return Starlette(routes=routes, middleware=[Middleware(AccessMiddleware, token=token)], lifespan=lifespan)


class WebServer:
    """Runs uvicorn in a thread."""

    def __init__(self, app: Starlette, listener: socket.socket) -> None:
        config = uvicorn.Config(
            app,
            log_config=None,
            log_level="warning",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            ws=UnbufferedWebSocketProtocol,
            ws_max_size=MAX_MESSAGE_BYTES,
            ws_per_message_deflate=False,
            ws_ping_interval=10,
            ws_ping_timeout=20,
            limit_concurrency=4 * MAX_VISITORS,
            timeout_graceful_shutdown=1,
            lifespan="on",
        )
        self._server = uvicorn.Server(config)
        run = self._server.run
        self._thread = threading.Thread(target=lambda: run(sockets=[listener]), name="web", daemon=True)

    def start(self) -> None:
        """Starts the server and returns once it accepts connections. Raises UserError if that fails."""
        self._thread.start()
        wait_until(lambda: self._server.started or not self._thread.is_alive(), 20)
        if not self._server.started:
            raise UserError("the web server did not start; see its log lines above")

    def stop(self) -> None:
        """Stops the server, even if visitors are connected."""
        self._server.should_exit = True
        self._thread.join(5)

    @property
    def running(self) -> bool:
        """Whether the server's thread is running."""
        return self._thread.is_alive()


def listen(settings: ViewerSettings) -> socket.socket:
    """Returns a socket listening on the configured port, or else on the first free one from `FIRST_PORT`.

    Raises UserError if no port can be used.
    """
    wanted = [settings.port] if settings.port is not None else [*range(FIRST_PORT, FIRST_PORT + PORTS_TO_TRY), 0]
    for port in wanted:
        try:
            return _bind(settings.host, port)
        except OSError as error:
            if error.errno == errno.EADDRINUSE and port != wanted[-1]:
                continue
            raise UserError(
                f"{settings.host} port {port} cannot be used ({error.strerror}): choose another port with --port, 0 "
                "for any free one, or another address with --host"
            ) from None
    raise AssertionError


def _bind(host: str, port: int) -> socket.socket:
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)  # inherited by connections
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, TCP_TIMEOUT_MS)
        listener.bind(address)
        listener.listen()  # if two viewers bind the port at the same time, one of them fails here
    except OSError:
        listener.close()
        raise
    return listener


def link(settings: ViewerSettings, listener: socket.socket) -> str:
    """Address of the page, for a browser on this machine, including the token."""
    port = listener.getsockname()[1]
    host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(settings.host, settings.host)  # noqa: S104 - compared with
    host = f"[{host}]" if ":" in host and not host.startswith("[") else host
    address = settings.address or f"http://{host}:{port}"
    return f"{address}/" + (f"?token={settings.token}" if settings.token else "")
