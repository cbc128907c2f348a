"""`presage rerun`: another estimator over a recording, in process.

The new recording has every message of the old one, byte for byte, with its metadata and attachments, and the new
beliefs and predictions under the name of another robot: presage/ROBOT-rerun/belief. So nothing is mistaken for what
happened: who listens to ROBOT in a replay of it, a controller or a viewer, sees the old beliefs, who listens to
ROBOT-rerun the new ones. A new belief stands right behind the old one of its stamp, and `presage plot`, which draws
one robot, draws the old.

The estimator is the service itself without its bus, so it takes odometry, goals and commands as it would there. It is
given every scan, also those the live estimator was too slow for; the numbers are of the scans that both answered.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from common.errors import UserError
from common.log import set_up_logging
from common.messages.definitions import Belief, Stamped, Truth
from common.messages.topics import BELIEF, SCAN, TRUTH, Topic, topic_of
from common.messages.wire import DecodeError
from common.versions import commit, versions
from presage.replay.recorded_session import check_mount, estimator_settings, recorded_settings, robot_of
from presage.replay.report import Comparison, Series, Track, draw, table
from presage.terminal.output import check_file, write_json
from services.estimator.service import EstimatorService
from services.estimator.settings import EstimatorSettings
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import Raw, Recording, read_recording

OWN = "-rerun"  # behind the robot's name


@dataclass(frozen=True)
class RerunOptions:
    """What is asked for."""

    file: Path
    chosen: dict[str, Any] = field(default_factory=dict)  # settings of the estimator that are not the recorded ones
    out: Path | None = None  # none: beside the recording

    def target(self, estimator: str) -> Path:
        """Where the new recording goes; raises UserError where something is there already."""
        stem = self.file.name.removesuffix(".active").removesuffix(".mcap")
        out = self.out or self.file.with_name(f"{stem}-{estimator}.mcap")
        if out.suffix != ".mcap":
            raise UserError(f"{out}: a recording is named NAME.mcap")
        if out.exists():
            raise UserError(f"{out}: is there already; choose another name with --out")
        return out


class Offline(EstimatorService):
    """The estimator's service on no bus: what it says is kept until it is taken."""

    def __init__(self, settings: EstimatorSettings) -> None:
        """Ready for messages once `open` was called."""
        super().__init__(settings)
        self.said: list[tuple[Topic, Stamped]] = []
        self._numbers: dict[Topic, int] = {}

    def publish(self, topic: Topic, message: Stamped) -> None:
        """Numbered as on the bus."""
        number = self._numbers.get(topic, 0)
        self._numbers[topic] = number + 1
        self.said.append((topic, message.model_copy(update={"seq": number})))


def rerun_command(job: RerunOptions, json_file: Path | None, console: Console) -> None:
    """Everything; raises UserError in one line."""
    check_file(json_file, "--json")
    set_up_logging("warning")
    recording = read_recording(job.file)
    if recording.warning:
        print(f"warning: {recording.warning}", file=sys.stderr)
    robot = robot_of(recording)
    if not recording.counts()[SCAN.key(robot)]:
        raise UserError(f"{job.file}: no scan in it")
    with tempfile.TemporaryDirectory(prefix="presage-") as folder:
        settings = settings_of(recording, job.chosen, Path(folder), console)
        out = job.target(settings.estimator)
        for beside in (".png", ".pdf", ".csv"):
            check_file(out.with_suffix(beside), "--out")
        with console.status(f"loading {settings.estimator}"):
            service = Offline(settings)
            service.open()
        track = write_both(recording, robot, service, out, console)
    if recording.problem:  # found where it was read
        console.print(f"[bold red]{recording.warning}[/]", highlight=False, soft_wrap=True)
    comparison = track.compare()
    if not comparison.new.beliefs:
        console.print(f"[bold]no belief came of it[/]: {service.note or 'the scans could not be used'}")
    console.print(table(comparison))
    files = draw(comparison, out)
    for path in (out, *files):
        console.print(f"wrote {path}", highlight=False, soft_wrap=True)
    about = {"file": str(job.file), "out": str(out), "robot": robot, "settings": service.options.effective()}
    meta = {"commit": commit(), "versions": versions(), "arguments": sys.argv[1:]}
    write_json(json_file, {**about, **comparison.as_dict(), **meta})


def settings_of(recording: Recording, chosen: dict[str, Any], folder: Path, console: Console) -> EstimatorSettings:
    """The recorded ones, where there are any, with those chosen in their place."""
    recorded = recorded_settings(recording, "estimator")
    was = dict(recorded.values) if recorded else {}
    same = chosen.get("estimator", was.get("estimator")) == was.get("estimator")
    if not same or "model" in chosen:
        was |= {"model": "learned", "models": None}
    as_recorded = same and not {"model", "models", "world"} & chosen.keys()
    unpacked = estimator_settings(recording, folder, {**was, **chosen}, weights=as_recorded)
    values = {**unpacked.values, **({"world": chosen["world"]} if "world" in chosen else {})}
    if "world" not in values:
        raise UserError(f"{recording.path}: no world was recorded: name it with --world")
    for note in (*(recorded.notes if recorded else ()), *unpacked.notes):
        console.print(note, highlight=False)
    settings = EstimatorSettings(**values)
    check_mount(recording, settings)
    return settings


def write_both(recording: Recording, robot: str, service: Offline, out: Path, console: Console) -> Track:
    """The new recording; errors and times of both. An unfinished one is not kept."""
    writer = RecordingWriter(out)
    try:
        alias = another_name(recording, robot)
        _describe(recording, service, alias, writer)
        copier = _Copier(service, robot, alias, writer)
        columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task(f"{service.options.estimator}", total=recording.counts()[SCAN.key(robot)])
            for raw in recording.payloads():
                if copier.take(raw):
                    bar.advance(task)
        copier.flush()
        writer.finish()
    except BaseException:
        writer.finish().unlink(missing_ok=True)
        raise
    if copier.foreign:
        console.print(f"{copier.foreign} messages on keys that are none of presage's are not copied")
    return copier.track


def another_name(recording: Recording, robot: str) -> str:
    """ROBOT-rerun; in a recording of a rerun ROBOT-rerun2, and so on."""
    there = {key.split("/")[1] for key in recording.topics()}
    names = (f"{robot}{OWN}{number if number > 1 else ''}" for number in itertools.count(1))
    return next(name for name in names if name not in there)


def _describe(recording: Recording, service: Offline, alias: str, writer: RecordingWriter) -> None:
    for name, values in recording.metadata.items():
        writer.metadata(name, values)
    for name, data in recording.attachments.items():
        writer.attachment(name, data, "application/octet-stream", recording.start_ns)
    said = {"config": json.dumps(service.options.effective()), "file": recording.path.name, **versions()}
    writer.metadata(f"rerun:{alias}", said)


class _Copier:
    """One pass: each message on, to the estimator what it hears, and what it says behind the old answer."""

    def __init__(self, service: Offline, robot: str, alias: str, writer: RecordingWriter) -> None:
        self.service, self.robot, self.alias, self.writer = service, robot, alias, writer
        self.inputs = {topic.key(robot): topic for topic in service.inputs}
        self.track = Track(Series(), Series(service.options.estimator))
        self.foreign = 0
        self._waiting: list[tuple[int, Topic, Stamped]] = []  # scan's times, and what was said about it

    def take(self, raw: Raw) -> bool:
        """One message of the recording; whether it was a scan."""
        topic = topic_of(raw.key)
        if topic is None:
            self.foreign += 1
            return False
        self.writer.write(topic, raw.key, raw.payload, raw.published_ns, raw.logged_ns)
        if raw.key not in self.inputs and raw.key not in (BELIEF.key(self.robot), TRUTH.key(self.robot)):
            return False
        try:
            message = topic.message.decode(raw.payload)
        except DecodeError:
            return topic is SCAN
        if isinstance(message, Belief):
            self.track.old.add(message, raw.logged_ns, (raw.published_ns - self.track.scanned_ns) * 1e-6)
            self._write(message.stamp_ns, raw.logged_ns + 1)
        elif isinstance(message, Truth):
            self.track.true(message, raw.logged_ns)
        else:
            self._ask(topic, message, raw)
        return topic is SCAN

    def flush(self) -> None:
        """What no old answer was found for."""
        for at, topic, message in self._waiting:
            self._put(topic, message, at + 1)
        self._waiting.clear()

    def _ask(self, topic: Topic, message: Stamped, raw: Raw) -> None:
        if topic is SCAN:
            self.flush()
            self.track.scanned_ns = raw.published_ns
        began = time.perf_counter()
        self.service.on_message(topic, message)
        took = (time.perf_counter() - began) * 1e3
        said, self.service.said = self.service.said, []
        for kind, answer in said:
            self._waiting.append((raw.logged_ns, kind, answer))
            if isinstance(answer, Belief):
                self.track.new.add(answer, raw.logged_ns, took)

    def _write(self, stamp_ns: int, at: int) -> None:
        for _, topic, message in [entry for entry in self._waiting if entry[2].stamp_ns == stamp_ns]:
            self._put(topic, message, at)
        self._waiting = [entry for entry in self._waiting if entry[2].stamp_ns != stamp_ns]

    def _put(self, topic: Topic, message: Stamped, at: int) -> None:
        self.writer.write(topic, topic.key(self.alias), message.encode(), at, at)


__all__ = ["Comparison", "Offline", "RerunOptions", "rerun_command"]
