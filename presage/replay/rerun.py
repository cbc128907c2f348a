"""`presage rerun`: runs another estimator over a recording, in process.

The new recording contains all messages, metadata and attachments of the old one, unchanged, and the new beliefs and
predictions under another robot name: presage/ROBOT-rerun/belief. In a replay of it, subscribers of ROBOT therefore
receive the recorded beliefs, and subscribers of ROBOT-rerun the new ones. A new belief follows directly after the
recorded belief of the same stamp. `presage plot`, which draws one robot, draws the recorded beliefs.

The estimator is the service itself without its bus, so that it processes odometry, goals and commands in the same way.
It receives every scan, also those for which the live estimator was too slow; the two estimators are compared on the
scans that both answered.
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
from presage.replay.report import BeliefSeries, Comparison, ComparisonBuilder, draw, table
from presage.terminal.output import check_file, write_json
from services.estimator.service import EstimatorService
from services.estimator.settings import EstimatorSettings
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import Raw, Recording, read_recording

RERUN_SUFFIX = "-rerun"  # of the robot's name


@dataclass(frozen=True)
class RerunOptions:
    """Options of `presage rerun`."""

    file: Path
    chosen: dict[str, Any] = field(default_factory=dict)  # estimator settings that replace the recorded ones
    out: Path | None = None  # defaults to a file beside the recording

    def target(self, estimator: str) -> Path:
        """Path of the new recording; raises UserError if it exists already."""
        stem = self.file.name.removesuffix(".active").removesuffix(".mcap")
        out = self.out or self.file.with_name(f"{stem}-{estimator}.mcap")
        if out.suffix != ".mcap":
            raise UserError(f"{out}: the name of a recording must end with .mcap")
        if out.exists():
            raise UserError(f"{out}: exists already; choose another name with --out")
        return out


class OfflineEstimatorService(EstimatorService):
    """The estimator service without a bus: published messages are collected in `published`."""

    def __init__(self, settings: EstimatorSettings) -> None:
        """Call `open` before the first message."""
        super().__init__(settings)
        self.published: list[tuple[Topic, Stamped]] = []
        self._numbers: dict[Topic, int] = {}

    def publish(self, topic: Topic, message: Stamped) -> None:
        """Collects a message, with its sequence number as on the bus."""
        number = self._numbers.get(topic, 0)
        self._numbers[topic] = number + 1
        self.published.append((topic, message.model_copy(update={"seq": number})))


def rerun_command(job: RerunOptions, json_file: Path | None, console: Console) -> None:
    """Runs the estimator, writes the new recording, and prints and draws the comparison.

    Raises UserError if the recording lacks something or a file cannot be written.
    """
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
            service = OfflineEstimatorService(settings)
            service.open()
        builder = write_recording(recording, robot, service, out, console)
    if recording.problem:  # only known after reading
        console.print(f"[bold red]{recording.warning}[/]", highlight=False, soft_wrap=True)
    comparison = builder.compare()
    if not comparison.new.beliefs:
        console.print(f"[bold]the estimator published no belief[/]: {service.note or 'the scans could not be used'}")
    console.print(table(comparison))
    files = draw(comparison, out)
    for path in (out, *files):
        console.print(f"wrote {path}", highlight=False, soft_wrap=True)
    about = {"file": str(job.file), "out": str(out), "robot": robot, "settings": service.settings.effective()}
    meta = {"commit": commit(), "versions": versions(), "arguments": sys.argv[1:]}
    write_json(json_file, {**about, **comparison.as_dict(), **meta})


def settings_of(recording: Recording, chosen: dict[str, Any], folder: Path, console: Console) -> EstimatorSettings:
    """The recorded settings, if there are any, with the ``chosen`` ones in their place."""
    recorded = recorded_settings(recording, "estimator")
    base = dict(recorded.values) if recorded else {}
    same_estimator = chosen.get("estimator", base.get("estimator")) == base.get("estimator")
    if not same_estimator or "model" in chosen:
        base |= {"model": "learned", "models": None}
    use_recorded_weights = same_estimator and not {"model", "models", "world"} & chosen.keys()
    unpacked = estimator_settings(recording, folder, {**base, **chosen}, weights=use_recorded_weights)
    values = {**unpacked.values, **({"world": chosen["world"]} if "world" in chosen else {})}
    if "world" not in values:
        raise UserError(f"{recording.path}: no world was recorded: give one with --world")
    for note in (*(recorded.notes if recorded else ()), *unpacked.notes):
        console.print(note, highlight=False)
    settings = EstimatorSettings(**values)
    check_mount(recording, settings)
    return settings


def write_recording(
    recording: Recording, robot: str, service: OfflineEstimatorService, out: Path, console: Console
) -> ComparisonBuilder:
    """Writes the new recording while running the estimator; returns the data for the comparison.

    Removes the new recording if it cannot be finished.
    """
    writer = RecordingWriter(out)
    try:
        alias = unused_robot_name(recording, robot)
        _describe(recording, service, alias, writer)
        copier = _Copier(service, robot, alias, writer)
        columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task(f"{service.settings.estimator}", total=recording.counts()[SCAN.key(robot)])
            for raw in recording.payloads():
                if copier.process(raw):
                    bar.advance(task)
        copier.flush()
        writer.finish()
    except BaseException:
        writer.finish().unlink(missing_ok=True)
        raise
    if copier.foreign:
        console.print(f"{copier.foreign} messages on keys that do not belong to presage are not copied")
    return copier.builder


def unused_robot_name(recording: Recording, robot: str) -> str:
    """ROBOT-rerun, or if that is in the recording already, ROBOT-rerun2 and so on."""
    used = {key.split("/")[1] for key in recording.topics()}
    names = (f"{robot}{RERUN_SUFFIX}{number if number > 1 else ''}" for number in itertools.count(1))
    return next(name for name in names if name not in used)


def _describe(recording: Recording, service: OfflineEstimatorService, alias: str, writer: RecordingWriter) -> None:
    for name, values in recording.metadata.items():
        writer.metadata(name, values)
    for name, data in recording.attachments.items():
        writer.attachment(name, data, "application/octet-stream", recording.start_ns)
    facts = {"config": json.dumps(service.settings.effective()), "file": recording.path.name, **versions()}
    writer.metadata(f"rerun:{alias}", facts)


class _Copier:
    """Copies the messages of the recording, passes them to the estimator, and writes its outputs among them."""

    def __init__(self, service: OfflineEstimatorService, robot: str, alias: str, writer: RecordingWriter) -> None:
        self.service, self.robot, self.alias, self.writer = service, robot, alias, writer
        self.inputs = {topic.key(robot): topic for topic in service.inputs}
        self.builder = ComparisonBuilder(BeliefSeries(), BeliefSeries(service.settings.estimator))
        self.foreign = 0  # messages on unknown keys
        # Outputs that are not yet written: (time of logging of the scan, topic, message).
        self._pending: list[tuple[int, Topic, Stamped]] = []

    def process(self, raw: Raw) -> bool:
        """Processes one message of the recording; returns whether it is a scan."""
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
            update_ms = (raw.published_ns - self.builder.last_scan_ns) * 1e-6
            self.builder.old.add(message, raw.logged_ns, update_ms)
            self._write_pending(message.stamp_ns, raw.logged_ns + 1)
        elif isinstance(message, Truth):
            self.builder.add_truth(message, raw.logged_ns)
        else:
            self._update_estimator(topic, message, raw)
        return topic is SCAN

    def flush(self) -> None:
        """Writes the outputs for which there is no recorded belief of the same stamp."""
        for logged_ns, topic, message in self._pending:
            self._write(topic, message, logged_ns + 1)
        self._pending.clear()

    def _update_estimator(self, topic: Topic, message: Stamped, raw: Raw) -> None:
        if topic is SCAN:
            self.flush()
            self.builder.last_scan_ns = raw.published_ns
        start = time.perf_counter()
        self.service.on_message(topic, message)
        update_ms = (time.perf_counter() - start) * 1e3
        outputs, self.service.published = self.service.published, []
        for output_topic, output in outputs:
            self._pending.append((raw.logged_ns, output_topic, output))
            if isinstance(output, Belief):
                self.builder.new.add(output, raw.logged_ns, update_ms)

    def _write_pending(self, stamp_ns: int, logged_ns: int) -> None:
        for _, topic, message in [entry for entry in self._pending if entry[2].stamp_ns == stamp_ns]:
            self._write(topic, message, logged_ns)
        self._pending = [entry for entry in self._pending if entry[2].stamp_ns != stamp_ns]

    def _write(self, topic: Topic, message: Stamped, logged_ns: int) -> None:
        self.writer.write(topic, topic.key(self.alias), message.encode(), logged_ns, logged_ns)


__all__ = ["Comparison", "OfflineEstimatorService", "RerunOptions", "rerun_command"]
