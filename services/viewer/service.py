"""The viewer service: receives messages, and passes frames to the web server's thread.

The service's thread encodes frames and passes the bytes to the hub, which runs in the web server's thread and knows
which robots are watched. For a robot that no visitor watches, only the messages for the charts and the journal are
decoded.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

from common.bus.inbox import Sample
from common.messages.definitions import Health, Status
from common.messages.topics import MAP, SCAN, Topic
from common.messages.wire import DecodeError
from common.runtime.service import Service
from common.runtime.service_monitor import ServiceMonitor
from common.runtime.session_files import session_of, start_command
from common.versions import versions
from services.viewer.control import RobotControl, RobotLookup
from services.viewer.playback import Playback
from services.viewer.request_handler import RequestContext, RequestHandler
from services.viewer.server import WebServer, create_app, link, listen
from services.viewer.settings import ViewerSettings
from services.viewer.state.health_rows import rows_of
from services.viewer.state.robot_view import ALWAYS_READ_TOPICS, SHOWN_TOPICS, RobotView
from services.viewer.state.roster import Roster
from services.viewer.visitors import Hub, Visitor

TICK_PERIOD_S = 1.0
NO_MAP = json.dumps({"type": "map", "world": None})
UNWATCHED_TIMEOUT_S = 600.0  # a robot is unsubscribed after this time without a visitor, except the configured one


@dataclass
class FollowedRobot:
    """A robot whose messages are subscribed."""

    view: RobotView
    monitor: ServiceMonitor
    unread: dict[Topic, Sample] = field(default_factory=dict)  # newest of each topic, not decoded yet
    watched_at: float = field(default_factory=time.monotonic)  # monotonic time at which a visitor last watched, s
    unsubscribe: list[Callable[[], None]] = field(default_factory=list)


class ViewerService(Service):
    """Serves the live page."""

    name: ClassVar[str] = "viewer"
    all_robots: ClassVar[bool] = True

    def __init__(self, settings: ViewerSettings) -> None:
        super().__init__(settings)
        self.options = settings
        self.hub = Hub(self._wake)
        self.roster = Roster(settings.robot)
        self.playback = Playback(settings.recordings, settings.robot, settings.connect, settings.security)
        self.pool = ThreadPoolExecutor(16, "action")
        self.robots: dict[str, FollowedRobot] = {}
        self._reopened: set[str] = set()  # robots of replays that now show another recording
        self._changed: deque[str] = deque()  # robots whose services started or ended
        self._ended_mappers: deque[str] = deque()  # robots whose mapper ended
        self._connect = settings.link().connect_option
        self._tick_at = 0.0
        self._web: WebServer | None = None

    def open(self) -> None:
        """Subscribes to the robot's topics and starts the web server."""
        options = self.options
        listener = listen(options)
        self._follow(options.robot)
        self.loop.bus.watch_robots(self._on_liveliness)
        lookup = RobotLookup(self._status, self._stamp_ns)
        context = RequestContext(
            hub=self.hub,
            control=RobotControl(self.loop.bus, self.roster, lookup, self._connect),
            playback=self.playback,
            roster=self.roster,
            pool=self.pool,
            control_allowed=options.control,
            version=versions().get("presage", versions()["commit"]),
            on_new_recording=self._reopened.add,
        )
        self.request_handler = RequestHandler(context)
        self._web = WebServer(create_app(self.request_handler, options.token, self.hub.set_loop), listener)
        self._web.start()
        where = f"page: {link(options, listener)}"
        if options.log_json:
            self.log.info(where)
        else:
            print(where, flush=True)
        if not options.on_loopback and not options.token:
            warning = "anyone who reaches this machine can see the page"
            if options.allow_control:
                warning = "anyone who reaches this machine can see the page and drive the robot"
            self.log.warning(warning, advice="set PRESAGE_VIEWER_TOKEN to require a token")

    def close(self) -> None:
        """Stops the web server and closes the open recording."""
        if self._web is not None:
            self._web.stop()
        self.playback.leave()
        self.pool.shutdown(wait=False, cancel_futures=True)

    # ---- messages from the bus

    def on_sample(self, sample: Sample) -> None:
        """Decodes the sample if it is needed now, or keeps the newest one for the next visitor."""
        robot = sample.key.split("/")[1]
        followed = self.robots.get(robot)
        if followed is None or sample.topic not in SHOWN_TOPICS:
            return
        if sample.topic is SCAN:
            followed.monitor.add_scan(time.monotonic())
        if robot in self.hub.watched or sample.topic in ALWAYS_READ_TOPICS:
            self._read(robot, followed, sample)
        else:
            followed.unread[sample.topic] = sample

    def _read(self, robot: str, followed: FollowedRobot, sample: Sample) -> None:
        try:
            message = sample.topic.message.decode(sample.payload)
        except DecodeError as error:
            self.loop.reject(sample.key, str(error))
            return
        now = time.monotonic()
        if isinstance(message, Health):
            followed.monitor.add_health(message, now)
            return
        view = followed.view
        self._show(robot, view, view.add(sample.topic, message, now, sample.published_ns))
        self._send_changes(robot, view)

    def _send_changes(self, robot: str, view: RobotView) -> None:
        if view.map_changed:
            view.map_changed = False
            self._send_text(robot, "map", view.map or NO_MAP)
        if view.time_restarted:
            view.time_restarted = False
            self._send_text(robot, "history", _history(view))
        if view.journal_changed:
            view.journal_changed = False
            self._send_text(robot, "journal", _journal(view))

    def _show(self, robot: str, view: RobotView, frame: bytes | None) -> None:
        if (field := view.fields.change(view.stamp_ns, live=view.live)) is not None:
            self._send_text(robot, "field", field)
        if frame is not None and robot in self.hub.watched:
            self.counters["frames"] += 1
            self.hub.call_soon(partial(self.hub.queue_frame, robot, frame))

    def _send_text(self, robot: str, kind: str, text: str | bytes) -> None:
        if robot in self.hub.watched:
            self.hub.call_soon(partial(self.hub.queue_text, robot, kind, text))

    def _on_liveliness(self, robot: str, service: str, alive: bool) -> None:  # noqa: FBT001 - zenoh's thread
        self.roster.change(robot, service, alive)
        if service == "mapper" and not alive:
            self._ended_mappers.append(robot)
        self._changed.append(robot)
        self._wake()

    # ---- periodic work

    def due(self) -> float | None:
        """Seconds until `on_timer` is needed: for a new visitor, a delayed frame, or the next tick."""
        if self.hub.newcomers or self._changed or self._reopened:
            return 0.0
        now = time.monotonic()
        waits = [wait for f in self.robots.values() if (wait := f.view.due(now)) is not None]
        return max(0.0, min([self._tick_at - now, *waits]))

    def on_timer(self) -> None:
        """Sends delayed frames, welcomes new visitors, and updates the list of services once a second."""
        now = time.monotonic()
        while self._reopened:
            if (followed := self.robots.get(robot := self._reopened.pop())) is not None:
                followed.view, followed.unread = RobotView(robot, live=False), {}
        if changed := {self._changed.popleft() for _ in range(len(self._changed))}:
            self.hub.call_soon(partial(self.request_handler.robots_changed, frozenset(changed)))
        while self._ended_mappers:
            if (followed := self.robots.get(robot := self._ended_mappers.popleft())) is not None and followed.view.live:
                followed.unread.pop(MAP, None)
                followed.view.end_mapping()
                self._send_changes(robot, followed.view)
        while self.hub.newcomers:
            self._welcome(*self.hub.newcomers.popleft())
        for robot, followed in self.robots.items():
            self._show(robot, followed.view, followed.view.overdue(now))
        if now >= self._tick_at:
            self._tick_at = now + TICK_PERIOD_S
            self._tick()

    def _welcome(self, visitor: Visitor, robot: str) -> None:
        """Sends a new visitor the robot's state and history."""
        followed = self._follow(robot)
        for sample in sorted(followed.unread.values(), key=lambda sample: sample.received_ns):
            self._read(robot, followed, sample)
        followed.unread.clear()
        view = followed.view
        texts = {
            "history": _history(view),
            "services": self._services(robot, followed),
            "journal": _journal(view),
            "field": view.fields.shown,
            "map": view.map or NO_MAP,  # the page may still show that of an earlier session
        }

        def send() -> None:
            if visitor.robot != robot:  # the visitor has switched to another robot meanwhile
                return
            for kind, text in texts.items():
                if text is not None:
                    visitor.queue_text(text, kind)
            if view.frame is not None:
                visitor.queue_frame(view.frame)

        self.hub.call_soon(send)

    def _tick(self) -> None:
        watched, now = self.hub.watched, time.monotonic()
        for robot in {*watched, self.options.robot} & self.robots.keys():
            self.robots[robot].watched_at = now
        for robot, followed in list(self.robots.items()):
            idle = now - followed.watched_at
            if idle > UNWATCHED_TIMEOUT_S or (idle > 0 and not self.roster.services(robot)):
                self._unfollow(robot)
        for robot, followed in self.robots.items():
            followed.view.live = "replay" not in self.roster.services(robot)
            if robot in watched:
                self._send_text(robot, "services", self._services(robot, followed))
        for name, count in dict(self.hub.counters).items():  # a copy, because the web server's thread changes it
            self.counters[name] = count
        self.counters["visitors"] = len(self.hub)
        if self._web is not None and not self._web.running and not self.note:
            self.note = "the web server ended"
            self.log.error(self.note)

    def _services(self, robot: str, followed: FollowedRobot) -> str:
        now, linked, monitor = time.monotonic(), self.loop.bus.linked(), followed.monitor
        monitor.set_alive(self.roster.services(robot), now)
        missing = [*([] if linked else ["router"]), *monitor.missing(now)]
        session = session_of(robot, self._connect) if missing else None
        message = {
            "type": "services",
            "services": rows_of(monitor, now),
            "missing": [
                {"name": name, "start": start_command(name, robot, self._connect, session)} for name in missing
            ],
            "linked": linked,
        }
        return json.dumps(message)

    def _follow(self, robot: str) -> FollowedRobot:
        """Subscribes to the robot's topics, unless that was done before."""
        if robot not in self.robots:
            live = "replay" not in self.roster.services(robot)
            followed = self.robots[robot] = FollowedRobot(RobotView(robot, live=live), ServiceMonitor(robot))
            for topic in SHOWN_TOPICS:
                # A replay publishes the messages of one step at once. All are kept, because the newest messages
                # of different topics may have different stamps.
                end = self.loop.bus.subscribe(topic, self.loop.inbox, keep_all=not live, robot=robot)
                followed.unsubscribe.append(end)
        return self.robots[robot]

    def _unfollow(self, robot: str) -> None:
        for unsubscribe in self.robots.pop(robot).unsubscribe:
            unsubscribe()

    # ---- called from other threads

    def _wake(self) -> None:
        if self._loop is not None:
            self._loop.inbox.wake()

    def _status(self, robot: str) -> Status | None:
        followed = self.robots.get(robot)
        return followed.view.status if followed is not None else None

    def _stamp_ns(self, robot: str) -> int:
        followed = self.robots.get(robot)
        return followed.view.stamp_ns if followed is not None else 0


def _history(view: RobotView) -> str:
    return json.dumps({"type": "history", "samples": view.history.columns()})


def _journal(view: RobotView) -> str:
    return json.dumps({"type": "journal", "rows": view.journal.rows()})
