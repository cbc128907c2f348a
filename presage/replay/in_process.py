"""Services in this process that exchange messages by function calls instead of a bus."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from common.bus.inbox import Inbox, IncomingRequest, RequestResult, Sample
from common.messages.definitions import Stamped
from common.messages.requests import Request
from common.messages.topics import Query, Topic
from common.runtime.service import Service
from common.runtime.service_loop import ServiceLoop


class InProcessServices:
    """Services of one robot. What one publishes is delivered to the others at once, in order.

    Timers do not run and no health is published, so that results do not depend on the machine's speed.
    """

    def __init__(self, services: Sequence[Service], robot: str) -> None:
        """Opens the services; raises UserError if one cannot start."""
        self.robot, self.instance = robot, "in-process"
        self._outbox: deque[tuple[Topic, bytes]] = deque()
        self._loops = [ServiceLoop(service, self, Inbox()) for service in services]  # type: ignore[arg-type] # as bus
        for service in services:
            service.open()

    def send(self, topic: Topic, payload: bytes) -> list[Stamped]:
        """Delivers a message, and returns what the services published because of it, in order."""
        published = []
        self._deliver(topic, payload)
        while self._outbox:
            output, data = self._outbox.popleft()
            published.append(output.message.decode(data))
            self._deliver(output, data)
        return published

    @property
    def notes(self) -> str:
        """The services' notes, for messages."""
        return "; ".join(loop.service.note for loop in self._loops if loop.service.note)

    def _deliver(self, topic: Topic, payload: bytes) -> None:
        for loop in self._loops:
            if topic in loop.service.inputs:
                loop.handle(Sample(topic, topic.key(self.robot), payload, 0, 0))
                while isinstance(answer := loop.inbox.get(0), RequestResult):
                    loop.handle(answer)

    # The part of `common.bus.bus.Bus` that services use while they handle messages.

    def put(self, topic: Topic, payload: bytes, service: str = "*", key: str | None = None) -> None:  # noqa: ARG002
        """Queues a message of a service."""
        self._outbox.append((topic, payload))

    def send_request(self, query: Query, request: Request, number: int, inbox: Inbox, timeout: float) -> None:  # noqa: ARG002
        """Passes a query to the service that answers it, which replies at once."""

        def reply(payload: bytes) -> None:
            inbox.put(RequestResult(query, number, payload))

        def refuse(reason: str) -> None:
            inbox.put(RequestResult(query, number, b"", reason))

        server = next((loop for loop in self._loops if query in loop.service.queries), None)
        if server is None:
            refuse("no service here answers")
        else:
            server.handle(IncomingRequest(query, request.encode(), reply, refuse))

    def publisher(self, topic: Topic, service: str) -> None:
        """Does nothing: within one process, publishers need not be declared."""
