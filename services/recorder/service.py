"""The recorder service: writes the messages of all topics to files."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import ClassVar

from common.bus.inbox import OTHERS, Sample
from common.errors import UserError
from common.messages.requests import RecordReply, RecordRequest, Reply, Request
from common.messages.topics import HEALTH, RECORDING, TOPICS, Query, Topic
from common.names import split_names
from common.runtime.service import Service
from services.recorder.files.message_counts import MAX_COUNT
from services.recorder.recording import OpenRecording, warn_about_unfinished
from services.recorder.session_description import DescriptionCollector, DescriptionReply
from services.recorder.settings import RecorderSettings

# The recorder may start before the other services of the robot, but warns if this lasts longer.
SERVICE_WARNING_DELAY_S = 10.0
INBOX_CAPACITY = 20_000  # messages that wait to be written


class RecorderService(Service):
    """Records all topics, from the start or on request."""

    name: ClassVar[str] = "recorder"
    inputs: ClassVar[tuple[Topic, ...]] = tuple(topic for topic in TOPICS if topic.recorded)
    queries: ClassVar[tuple[Query, ...]] = (RECORDING,)
    keep_all: ClassVar[bool] = True

    def __init__(self, settings: RecorderSettings, *, serve_requests: bool = True) -> None:
        """Opens no file yet: `open` or a request does. It serves the query `recording` only if ``serve_requests``."""
        super().__init__(settings)
        if not serve_requests:
            self.queries = ()  # type: ignore[misc]
        self.options = settings
        self.inputs = parse_topics(settings.topics)  # type: ignore[misc]
        self.recording: OpenRecording | None = None
        self.descriptions: DescriptionCollector | None = None
        # By service and type: the last description of each.
        self._last_descriptions: dict[tuple[str, type[DescriptionReply]], DescriptionReply] = {}
        self._ended = RecordReply()  # final state of the last recording
        self._written: Counter[str] = Counter()  # by key, in completed recordings
        self._missing: Counter[str] = Counter()  # by key, in completed recordings
        self._flush_at = 0.0
        self._opened_at = 0.0
        self._checks_reception = True  # until another service, or a message of one, was found
        self._reception_problem = ""  # why no messages arrive, as far as is known
        self._failure = ""  # why the last recording ended by itself

    def open(self) -> None:
        """Begins to record, unless idle, and starts to collect the services' descriptions."""
        options = self.options
        self.loop.inbox.capacity = INBOX_CAPACITY
        warn_about_unfinished(options.directory, self.log)
        if not options.idle:
            self._begin(may_rename=False)
        self._update_note()
        self._opened_at = time.monotonic()
        self._flush_at = self._opened_at + options.flush
        self.descriptions = DescriptionCollector(self.loop.bus, self.name, self.log, weights=options.weights)

    def on_sample(self, sample: Sample) -> None:
        """Writes the sample if a recording is open."""
        if self.recording is None:
            return
        if self.loop.inbox.counter_name(sample.key) != sample.key:  # there are already MAX_KEYS other keys
            self.loop.inbox.dropped[OTHERS] += 1
            self.counters["messages_rejected"] += 1
            return
        with self._surviving_failures():
            self.recording.write(sample)
            self.counters["written"] += 1
            self.counters["written_bytes"] += len(sample.payload)

    def on_request(self, query: Query, request: Request) -> Reply | Future[Reply]:
        """Starts or stops a recording, and returns its state."""
        if not isinstance(request, RecordRequest):
            return super().on_request(query, request)
        state = self._state()
        if request.action == "start":
            if self.recording is not None:
                return state.model_copy(update={"ok": False, "reason": f"already recording, into {state.file}"})
            self._begin(may_rename=True)
        elif request.action == "stop":
            if self.recording is None:
                return state.model_copy(update={"ok": False, "reason": "not recording"})
            self._write_descriptions()
            self._end()
        return self._state()

    def _state(self) -> RecordReply:
        return self._ended if self.recording is None else self.recording.state()

    def _begin(self, *, may_rename: bool) -> None:
        """Opens a new file, writes the known descriptions, and queries them again in case the world has changed."""
        self.recording = OpenRecording(self.options, self.inputs, self.loop.inbox, may_rename=may_rename)
        self._failure = ""
        self._update_note()
        self.log.info("recording", file=self.recording.state().file)
        if self.descriptions is not None:
            for (service, _), reply in self._last_descriptions.items():
                if service in self.descriptions.present:
                    self.recording.describe(service, reply)
            self.descriptions.query_all()

    def _end(self) -> None:
        """Completes the file. The recording counts as ended even if this fails."""
        recording, self.recording = self.recording, None
        assert recording is not None  # noqa: S101 - checked by the callers
        state, dropped, missing = recording.state(), recording.dropped(), recording.missing()
        self._ended = state.model_copy(update={"recording": False})
        self._update_note()
        for key, written in recording.message_counts.written.items():
            self._written[key] += written
            self._missing[key] += recording.message_counts.sequence_totals(key).missing
        writer = recording.writer
        try:
            files = writer.finish()
        finally:
            if writer.failed:
                self._ended = self._ended.model_copy(update={"messages": writer.saved})
                self.log.error(
                    "recording is incomplete",
                    file=str(writer.part.active) if writer.part.active.exists() else "none",
                    messages=writer.saved,
                    lost=recording.not_in_file(),
                    dropped=dropped,
                    missing=missing,
                )
        file = str(files[-1]) if files else ""
        self._ended = self._ended.model_copy(update={"file": file})
        if not writer.failed:
            parts = {"parts": len(files)} if len(files) > 1 else {}
            counts = {"messages": state.messages, "dropped": dropped, "missing": missing}
            self.log.info("recorded", file=file, **counts, **parts)

    def extra_counts(self, key: str) -> dict[str, int]:
        """Written and missing messages of a key, for the health message."""
        written, missing = self._written[key], self._missing[key]
        if self.recording is not None:
            message_counts = self.recording.message_counts
            written += message_counts.written.get(key, 0)
            missing += message_counts.sequence_totals(key).missing
        return {"written": written, "missing": min(missing, MAX_COUNT)}

    def due(self) -> float | None:
        """Seconds until the next flush."""
        return self._flush_at - time.monotonic()

    def on_timer(self) -> None:
        """Writes new descriptions, checks the link and flushes the file."""
        self._flush_at = time.monotonic() + self.options.flush
        with self._surviving_failures():
            self._write_descriptions()
            if self.recording is not None:
                self.recording.writer.flush()
        self._warn_if_nothing_arrives()

    @contextmanager
    def _surviving_failures(self) -> Iterator[None]:
        """If recordings are started on request, ends only the recording, not the service, when a file fails."""
        try:
            yield
        except UserError as error:
            if not self.options.idle or self.recording is None:
                raise
            self.log.warning("the recording has ended", reason=str(error))
            self._failure = str(error)
            with suppress(UserError):  # the file cannot be completed either, and this was logged
                self._end()

    def close(self) -> None:
        """Writes the messages that are still queued and completes the file."""
        inbox, descriptions = self.loop.inbox, self.descriptions
        if descriptions is None:
            return
        descriptions.stop()
        try:
            if self.recording is not None and not self.recording.writer.failed:
                for _ in range(inbox.capacity):  # bounded, because others may continue to publish
                    if (entry := inbox.get(0)) is None:
                        break
                    if isinstance(entry, Sample):
                        self.on_sample(entry)
                self._write_descriptions()
        finally:
            if self.recording is not None:
                self._end()
            descriptions.join()

    def _warn_if_nothing_arrives(self) -> None:
        """Warns once if the robot has no services, and logs when that has changed."""
        if not self._checks_reception:
            return
        problem, advice = self._find_reception_problem()
        if problem == self._reception_problem:
            return
        if problem:
            self.log.warning(problem, advice=advice)
        else:
            self.log.info("messages can arrive now", robot=self.options.robot)
        self._reception_problem = problem
        self._update_note()

    def _find_reception_problem(self) -> tuple[str, str]:
        """Why no messages arrive, and what to do; both empty if they do, or if it is too early to tell."""
        open_for = time.monotonic() - self._opened_at
        if self._has_messages_of_others() or (self.descriptions is not None and self.descriptions.present):
            self._checks_reception = False
            return "", ""
        not_linked = self.options.connect and not self.loop.bus.linked()  # the loop warns of that
        if not_linked or open_for < SERVICE_WARNING_DELAY_S:
            return "", ""
        return f"no service of robot {self.options.robot} is running", "start one, or name another robot with --robot"

    def _has_messages_of_others(self) -> bool:
        own = HEALTH.key(self.options.robot, self.name)
        return self.recording is not None and any(key != own for key in self.recording.message_counts.written)

    def _update_note(self) -> None:
        """Sets the note in the health message."""
        self.idle = self.recording is None
        idle = (
            f"the recording has ended: {self._failure}" if self._failure else "not recording until a request starts it"
        )
        self.note = self._reception_problem or (idle if self.idle else "")

    def _write_descriptions(self) -> None:
        if self.descriptions is None:
            return
        for service, reply in self.descriptions.new_replies():
            self._last_descriptions[service, type(reply)] = reply
            if self.recording is not None:
                self.recording.describe(service, reply)


def parse_topics(names: str) -> tuple[Topic, ...]:
    """Topics of the comma-separated names. Defaults to all recorded topics; raises UserError for an unknown name."""
    recorded = {topic.name: topic for topic in TOPICS if topic.recorded}
    wanted = split_names(names)
    if unknown := [name for name in wanted if name not in recorded]:
        raise UserError(f"no topic {', '.join(unknown)}: choose from {', '.join(recorded)}")
    return tuple(recorded[name] for name in dict.fromkeys(wanted)) if wanted else tuple(recorded.values())
