"""Send queues of visitors: a slow visitor skips frames and does not delay others."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from services.viewer.request_handler import RequestHandler
from services.viewer.visitors import MAX_QUEUED_TEXTS, Hub, TooSlowError, Visitor


class FakeConnection:
    """A browser's connection; a slow one receives one message per permit, others everything at once."""

    def __init__(self, *, slow=False):
        self.received = []
        self.permits = asyncio.Semaphore(0) if slow else None

    async def receive(self, message):
        if self.permits is not None:
            await self.permits.acquire()
        self.received.append(message)


async def settle():
    for _ in range(20):
        await asyncio.sleep(0)


def hub_with_visitors(*connections):
    """A hub with one visitor per connection, all watching one robot; also returns the visitors and their send tasks."""
    hub = Hub()
    visitors = [Visitor(each.receive, each.receive) for each in connections]
    for visitor in visitors:
        hub.watch(visitor, "robot")
    return hub, visitors, [asyncio.create_task(visitor.run()) for visitor in visitors]


def run(scenario):
    """Runs a test with an event loop, and then cancels the tasks that it has put into its list."""

    async def run_and_clean_up():
        tasks = []
        try:
            await scenario(tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(run_and_clean_up())


def test_slow_visitor():
    async def scenario(tasks):
        quick, slow = FakeConnection(), FakeConnection(slow=True)
        hub, visitors, running = hub_with_visitors(quick, slow)
        tasks += running
        frames = [bytes([i]) for i in range(30)]
        for i, frame in enumerate(frames):
            hub.queue_frame("robot", frame)
            await settle()
            if i == 14:
                slow.permits.release()
                await settle()
        assert quick.received == frames
        assert slow.received == [frames[0]]  # it was being sent when the others came
        slow.permits.release()
        slow.permits.release()
        await settle()
        assert slow.received == [frames[0], frames[14], frames[29]]
        assert [visitor.sent for visitor in visitors] == [30, 3]
        assert visitors[1].skipped == 27
        hub.remove(visitors[1])
        assert hub.counters == {"frames_sent": 3, "frames_skipped": 27}

    run(scenario)


def test_order_of_answers():
    async def scenario(tasks):
        connection = FakeConnection(slow=True)
        _, (visitor,), running = hub_with_visitors(connection)
        tasks += running
        visitor.queue_text("first")
        await settle()  # being sent
        visitor.queue_text("services 1", "services")
        visitor.queue_text("second")
        visitor.queue_text("services 2", "services")
        visitor.queue_text(b"field 1", "field")
        visitor.queue_text(b"field 2", "field")
        visitor.queue_frame(b"frame")
        for _ in range(9):
            connection.permits.release()
        await settle()
        assert connection.received == ["first", "services 2", "second", b"field 2", b"frame"]

    run(scenario)


def test_visitor_that_reads_nothing():
    async def scenario(tasks):
        connection = FakeConnection(slow=True)
        _, (visitor,), running = hub_with_visitors(connection)
        tasks += running
        for i in range(2 * MAX_QUEUED_TEXTS):
            visitor.queue_text(str(i))
            await asyncio.sleep(0)
        connection.permits.release()
        with pytest.raises(TooSlowError):
            await asyncio.wait_for(running[0], 5)

    run(scenario)


def test_change_of_robot():
    async def scenario(tasks):
        connection = FakeConnection(slow=True)
        hub, (visitor,), running = hub_with_visitors(connection)
        tasks += running
        visitor.queue_text("hello")
        await settle()
        hub.queue_frame("robot", b"old")
        visitor.queue_text("old world", "world")
        visitor.queue_text("answer")
        hub.watch(visitor, "ghost")
        hub.queue_frame("robot", b"other")
        hub.queue_frame("ghost", b"new")
        for _ in range(9):
            connection.permits.release()
        await settle()
        assert connection.received == ["hello", "answer", b"new"]
        assert hub.watched == {"ghost"}
        assert [robot for _, robot in hub.newcomers] == ["robot", "ghost"]

    run(scenario)


def test_hub_without_a_loop():
    hub, called = Hub(), []
    hub.call_soon(lambda: called.append(1))
    loop = asyncio.new_event_loop()
    hub.set_loop(loop)
    hub.call_soon(lambda: called.append(2))
    loop.call_soon(loop.stop)
    loop.run_forever()
    loop.close()
    hub.call_soon(lambda: called.append(3))
    assert called == [2]


def test_robot_after_a_recording():
    """A visitor who closes a recording watches the same robot as before."""

    async def scenario(tasks):
        hub, (visitor,), running = hub_with_visitors(FakeConnection())
        tasks += running
        handler = RequestHandler(
            SimpleNamespace(
                hub=hub,
                playback=SimpleNamespace(robot="robot-replay"),
                roster=SimpleNamespace(robot="robot", robots=lambda: ["robot", "truck"]),
                control_allowed=True,
                version="1",
            )
        )
        for robot in ("truck", "robot-replay"):
            handler.show_robot(visitor, robot)
        handler._on_closed("")
        assert visitor.robot == "truck"

    run(scenario)
