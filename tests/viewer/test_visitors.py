"""Send queues of visitors: a slow visitor skips frames and does not delay others."""

from __future__ import annotations

import asyncio

import pytest

from services.viewer.visitors import MAX_QUEUED_TEXTS, Hub, TooSlowError, Visitor


class Line:
    """A connection that takes one message per permit if it is slow, or else everything."""

    def __init__(self, *, slow=False):
        self.taken = []
        self.permits = asyncio.Semaphore(0) if slow else None

    async def take(self, what):
        if self.permits is not None:
            await self.permits.acquire()
        self.taken.append(what)


async def settle():
    for _ in range(20):
        await asyncio.sleep(0)


def scene(*lines):
    """A hub with one visitor per line, all watching one robot, and their running send tasks."""
    hub = Hub()
    visitors = [Visitor(line.take, line.take) for line in lines]
    for visitor in visitors:
        hub.watch(visitor, "robot")
    return hub, visitors, [asyncio.create_task(visitor.run()) for visitor in visitors]


def run(story):
    async def whole():
        tasks = []
        try:
            await story(tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(whole())


def test_slow_visitor():
    async def story(tasks):
        quick, slow = Line(), Line(slow=True)
        hub, visitors, running = scene(quick, slow)
        tasks += running
        frames = [bytes([i]) for i in range(30)]
        for i, frame in enumerate(frames):
            hub.queue_frame("robot", frame)
            await settle()
            if i == 14:
                slow.permits.release()
                await settle()
        assert quick.taken == frames
        assert slow.taken == [frames[0]]  # it was being sent when the others came
        slow.permits.release()
        slow.permits.release()
        await settle()
        assert slow.taken == [frames[0], frames[14], frames[29]]
        assert [visitor.sent for visitor in visitors] == [30, 3]
        assert visitors[1].skipped == 27
        hub.remove(visitors[1])
        assert hub.counters == {"frames_sent": 3, "frames_skipped": 27}

    run(story)


def test_order_of_answers():
    async def story(tasks):
        line = Line(slow=True)
        _, (visitor,), running = scene(line)
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
            line.permits.release()
        await settle()
        assert line.taken == ["first", "services 2", "second", b"field 2", b"frame"]

    run(story)


def test_visitor_that_reads_nothing():
    async def story(tasks):
        line = Line(slow=True)
        _, (visitor,), running = scene(line)
        tasks += running
        for i in range(2 * MAX_QUEUED_TEXTS):
            visitor.queue_text(str(i))
            await asyncio.sleep(0)
        line.permits.release()
        with pytest.raises(TooSlowError):
            await asyncio.wait_for(running[0], 5)

    run(story)


def test_change_of_robot():
    async def story(tasks):
        line = Line(slow=True)
        hub, (visitor,), running = scene(line)
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
            line.permits.release()
        await settle()
        assert line.taken == ["hello", "answer", b"new"]
        assert hub.watched == {"ghost"}
        assert [robot for _, robot in hub.newcomers] == ["robot", "ghost"]

    run(story)


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
