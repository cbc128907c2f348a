"""The process: records all topics."""

from __future__ import annotations

import time
from collections import Counter
from typing import ClassVar

from common.bus.inbox import OTHERS, Sample
from common.errors import UserError
from common.messages.requests import RecordReply, RecordRequest, Reply, Request, WorldReply
from common.messages.topics import RECORDING, TOPICS, WORLD, Query, Topic
from common.runtime.service import Service
from services.recorder.files.message_counts import MAX_COUNT
from services.recorder.files.parts import PartsWriter
from services.recorder.files.writer import RecordingWriter
from services.recorder.recording import OpenRecording, warn_about_unfinished, write_description
from services.recorder.session_description import DescriptionCollector, DescriptionReply
from services.recorder.settings import RecorderSettings

LINK_WARNING_DELAY_S = 3.0  # s; a recorder may come before the others, but should not wait for nobody in silence


class RecorderService(Service):
    """Recording as a process."""

    name: ClassVar[str] = "recorder"
    inputs: ClassVar[tuple[Topic, ...]] = tuple(topic for topic in TOPICS if topic.recorded)
    queries: ClassVar[tuple[Query, ...]] = (RECORDING,)
    keep_all: ClassVar[bool] = True

    def __init__(self, settings: RecorderSettings, *, remote: bool = True) -> None:
        """The file is opened in `open`, or on request; without ``remote`` no request begins or ends a recording."""
        super().__init__(settings)
        if not remote:
            self.queries = ()  # type: ignore[misc]
        self.options = settings
        self.inputs = chosen_topics(settings.topics)  # type: ignore[misc]
        self.recording: OpenRecording | None = None
        self.describer: DescriptionCollector | None = None
        self._said: dict[
            tuple[str, type[DescriptionReply]], DescriptionReply
        ] = {}  # by services of themselves, the last of each kind
        self._ended = RecordReply()  # how the last recording stood at its end
        self._written: Counter[str] = Counter()  # by key, into recordings that are complete
        self._missing: Counter[str] = Counter()
        self._flush_at = 0.0
        self._warn_at: float | None = None  # of nobody there; None: no more
        self._alone = ""  # what to say of that

    def open(self) -> None:
        """Begin to record, unless told to wait; ask who is there what it is."""
        options = self.options
        self.loop.inbox.capacity = options.capacity
        warn_about_unfinished(options.directory, self.log)
        if not options.idle:
            self._begin(numbered=False)
        self._say_whether_it_records()
        self._flush_at = time.monotonic() + options.flush
        self._warn_at = time.monotonic() + LINK_WARNING_DELAY_S if options.link().connect else None
        self.describer = DescriptionCollector(self.loop.bus, self.name, self.log, weights=options.weights)

    def on_sample(self, sample: Sample) -> None:
        """Into the file, where there is one."""
        if self.recording is None:
            return
        if self.loop.inbox.counted_as(sample.key) != sample.key:  # somebody invents keys
            self.loop.inbox.dropped[OTHERS] += 1
            self.counters["turned_away"] += 1
            return
        self.recording.write(sample)
        self.counters["written"] += 1
        self.counters["written_bytes"] += len(sample.payload)

    def on_request(self, query: Query, request: Request) -> Reply:
        """Begin, end, or say how it stands."""
        if not isinstance(request, RecordRequest):
            return super().on_request(query, request)
        state = self._state()
        if request.action == "start":
            if self.recording is not None:
                return state.model_copy(update={"ok": False, "reason": f"records already, into {state.file}"})
            self._begin(numbered=True)
        elif request.action == "stop":
            if self.recording is None:
                return state.model_copy(update={"ok": False, "reason": "records nothing: start first"})
            self._write_answers()
            self._end()
        return self._state()

    def _state(self) -> RecordReply:
        return self._ended if self.recording is None else self.recording.state()

    def _begin(self, *, numbered: bool) -> None:
        """A new file, with what is known of those who are there; they are asked again, for a world changes."""
        self.recording = OpenRecording(self.options, self.inputs, self.loop.inbox, numbered=numbered)
        self._say_whether_it_records()
        self.log.info("recording", file=self.recording.state().file)
        if self.describer is not None:
            for (service, _), answer in self._said.items():
                if service in self.describer.present:
                    self.recording.describe(service, answer)
            self.describer.query_all()

    def _end(self) -> None:
        """Complete the file. What fails is over all the same."""
        recording, self.recording = self.recording, None
        assert recording is not None  # noqa: S101 - callers have looked
        state, dropped, missing = recording.state(), recording.dropped(), recording.missing()
        self._ended = state.model_copy(update={"recording": False})
        self._say_whether_it_records()
        for key, written in recording.ledger.written.items():
            self._written[key] += written
            self._missing[key] += recording.ledger.lost(key).missing
        writer = recording.writer
        try:
            *_, path = files = writer.finish()
        finally:
            if writer.failed:
                self._ended = self._ended.model_copy(update={"messages": writer.saved})
                self.log.error(
                    "recording is incomplete", file=str(writer.part.active), messages=writer.saved,
                    lost=recording.lost(), dropped=dropped, missing=missing,
                )  # fmt: skip
        self._ended = self._ended.model_copy(update={"file": str(path)})
        if not writer.failed:
            parts = {"parts": len(files)} if len(files) > 1 else {}
            counts = {"messages": state.messages, "dropped": dropped, "missing": missing}
            self.log.info("recorded", file=str(path), **counts, **parts)

    def extra_counts(self, key: str) -> dict[str, int]:
        """For health: what was written of a key, and what never came."""
        written, missing = self._written[key], self._missing[key]
        if self.recording is not None:
            ledger = self.recording.ledger
            written, missing = written + ledger.written.get(key, 0), missing + ledger.lost(key).missing
        return {"written": written, "missing": min(missing, MAX_COUNT)}

    def due(self) -> float | None:
        """Until the next flush."""
        return self._flush_at - time.monotonic()

    def on_timer(self) -> None:
        """Now and then: what services said of themselves, then to disk."""
        self._flush_at = time.monotonic() + self.options.flush
        self._write_answers()
        self._look_for_others()
        if self.recording is not None:
            self.recording.writer.flush()

    def close(self) -> None:
        """What still waits, then the end of the file."""
        inbox, describer = self.loop.inbox, self.describer
        if describer is None:
            return
        describer.stop()
        try:
            if self.recording is not None and not self.recording.writer.failed:
                for _ in range(inbox.capacity):  # bounded: others may go on publishing
                    if (entry := inbox.get(0)) is None:
                        break
                    if isinstance(entry, Sample):
                        self.on_sample(entry)
                self._write_answers()
        finally:
            if self.recording is not None:
                self._end()
            describer.join()

    def _look_for_others(self) -> None:
        """Say once that nobody is there, and when somebody comes after that."""
        if self._warn_at is None or time.monotonic() < self._warn_at:
            return
        linked = self.loop.bus.linked()
        if not linked and not self._alone:
            self._alone = f"nothing answers at {', '.join(self.options.link().connect)}"
            advice = "start a session with `presage up`, or say where it is with --connect"
            self.log.warning(self._alone, advice=advice)
        elif linked:
            if self._alone:
                self.log.info("there it is")
            self._warn_at, self._alone = None, ""
        self._say_whether_it_records()

    def _say_whether_it_records(self) -> None:
        """The note in health."""
        self.note = self._alone or ("" if self.recording is not None else "records nothing until told")

    def _write_answers(self) -> None:
        if self.describer is None:
            return
        for service, answer in self.describer.answers():
            self._said[service, type(answer)] = answer
            if self.recording is not None:
                self.recording.describe(service, answer)


def chosen_topics(names: str) -> tuple[Topic, ...]:
    """The rows of those comma-separated names, or all that are marked; raises UserError for an unknown one."""
    recorded = {topic.name: topic for topic in TOPICS if topic.recorded}
    wanted = [part.strip() for part in names.split(",") if part.strip()]
    if unknown := [name for name in wanted if name not in recorded]:
        raise UserError(f"no topic {', '.join(unknown)}: choose from {', '.join(recorded)}")
    return tuple(recorded[name] for name in dict.fromkeys(wanted)) if wanted else tuple(recorded.values())


def write_world(writer: RecordingWriter | PartsWriter, reply: WorldReply) -> None:
    """The world as an attachment that `load_world` reads; scanner and robot as JSON."""
    write_description(writer, WORLD.server, reply)
