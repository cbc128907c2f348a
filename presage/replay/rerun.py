"""Writes a recording again with the beliefs of another estimator beside its own, and compares the two.

The new recording contains all messages, metadata and attachments of the old one, unchanged, and the new beliefs and
predictions under another robot name: presage/ROBOT-rerun/belief. In a replay of it, subscribers of ROBOT therefore
receive the recorded beliefs, and subscribers of ROBOT-rerun the new ones. A new belief follows directly after the
recorded belief of the same stamp. `presage plot`, which draws one robot, draws the recorded beliefs.

The estimator receives every scan, also those for which the live estimator was too slow; the two estimators are compared
on the scans that both answered.
"""

from __future__ import annotations

import itertools
import json
import tempfile
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from common.errors import UserError
from common.geometry.world import known_worlds, load_world
from common.log import set_up_logging
from common.messages.definitions import Belief, Prediction, Scan, Stamped
from common.messages.topics import BELIEF, PREDICTION, SCAN, Topic, topic_of
from common.messages.wire import DecodeError
from common.versions import versions
from presage.estimator import Estimator
from presage.logs.scan_files import Scans, read_scans
from presage.recordings.selection import robot_of
from presage.replay.estimator_comparison import BeliefSeries, compare, comparison_table, draw_comparison
from presage.replay.localize import TimedBelief, check_scans, prepare_estimator, run_estimator
from presage.replay.recorded_settings import estimator_settings, recorded_settings, settings_with
from presage.terminal.output import check_file, provenance, write_json
from presage.terminal.progress import progress
from services.estimator.factory import EstimatorOptions, check_start
from services.estimator.service import belief_message, estimator_options, prediction_message
from services.estimator.settings import EstimatorSettings, ignored_settings
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import RawMessage, Recording, read_recording

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


def rerun_command(options: RerunOptions, json_file: Path | None, console: Console) -> None:
    """Runs the estimator, writes the new recording, and prints and draws the comparison.

    Raises UserError if the recording lacks something or a file cannot be written.
    """
    check_file(json_file, "--json")
    set_up_logging("warning")
    recording = read_recording(options.file)
    robot = robot_of(recording)
    with tempfile.TemporaryDirectory(prefix="presage-") as folder:
        settings = settings_of(recording, options.chosen, Path(folder), console)
        for warning in ignored_settings(settings.estimator, options.chosen):
            console.print(f"warning: {warning}", highlight=False)
        out = options.target(settings.estimator)
        for beside in (".png", ".pdf", ".csv"):
            check_file(out.with_suffix(beside), "--out")
        chosen = estimator_options(settings)
        if "world" in options.chosen:
            estimator = prepare_estimator(chosen, console)
        else:
            estimator = _prepare_for_recorded_world(chosen, recording, console)
        all_scans = read_scans(options.file)
        check_scans(estimator, all_scans, console)
        scans = all_scans.with_prior(settings.prior)
        localised = run_estimator(estimator, scans, start=chosen.initial_pose)
        with closing(progress(localised, "localising", len(scans), console)) as shown:
            old, new = write_recording(recording, robot, settings, scans, shown, out)
    if foreign := sum(count for key, count in recording.counts.items() if topic_of(key) is None):
        console.print(f"{foreign} messages on keys that do not belong to presage are not copied")
    comparison = compare(old, new, scans.truth, changes_text(recording, settings, options.chosen))
    console.print(comparison_table(comparison))
    for path in (out, *draw_comparison(comparison, out)):
        console.print(f"wrote {path}", highlight=False, soft_wrap=True)
    about = {"file": str(options.file), "out": str(out), "robot": robot, "settings": settings.effective()}
    write_json(json_file, {**about, **comparison.as_dict(), **provenance()})


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
    return settings_with(EstimatorSettings, values)


def _prepare_for_recorded_world(chosen: EstimatorOptions, recording: Recording, console: Console) -> Estimator:
    """The chosen estimator for the recorded world; messages do not name the file of that in the temporary folder.

    Raises UserError if weights are missing.
    """
    world = chosen.loaded_world
    chosen = replace(chosen, world=world)
    try:
        check_start(chosen.initial_pose, world)
        return prepare_estimator(chosen, console)
    except UserError as error:
        if chosen.world_argument in known_worlds():
            raise
        attached = "model/world.yaml" if "model/world.yaml" in recording.attachments else "world.yaml"
        raise UserError(
            f"{error} ({chosen.world_argument} is the session's world, which {recording.path} contains as attachment "
            f"{attached})"
        ) from None


def changes_text(recording: Recording, settings: EstimatorSettings, chosen: Collection[str]) -> str:
    """The ``chosen`` settings that differ from the recorded ones, such as "alpha 0.02"; not the estimator's name."""
    recorded = recorded_settings(recording, "estimator")
    before = {} if recorded is None else settings_with(EstimatorSettings, recorded.values).effective()
    now = settings.effective()
    return ", ".join(
        f"{name} {now[name]}"
        for name in chosen
        if name != "estimator" and name in before and name in now and now[name] != before[name]
    )


def write_recording(
    recording: Recording,
    robot: str,
    settings: EstimatorSettings,
    scans: Scans,
    localised: Iterator[TimedBelief],
    out: Path,
) -> tuple[BeliefSeries, BeliefSeries]:
    """Writes the new recording, and returns the recorded and the new beliefs; no file is left if that fails."""
    writer = RecordingWriter(out)
    try:
        alias = unused_robot_name(recording, robot)
        for name, values in recording.metadata.items():
            writer.metadata(name, values)
        for name, data in recording.attachments.items():
            writer.attachment(name, data, "application/octet-stream", recording.start_ns)
        facts = {"config": json.dumps(settings.effective()), "file": recording.path.name, **versions()}
        writer.metadata(f"rerun:{alias}", facts)
        series = _copy(recording, robot, alias, settings, scans, localised, writer)
        writer.finish()
    except BaseException:
        writer.finish().unlink(missing_ok=True)
        raise
    return series


def unused_robot_name(recording: Recording, robot: str) -> str:
    """ROBOT-rerun, or if that is in the recording already, ROBOT-rerun2 and so on."""
    used = {key.split("/")[1] for key in recording.topics()}
    names = (f"{robot}{RERUN_SUFFIX}{number if number > 1 else ''}" for number in itertools.count(1))
    return next(name for name in names if name not in used)


def _copy(
    recording: Recording,
    robot: str,
    alias: str,
    settings: EstimatorSettings,
    scans: Scans,
    localised: Iterator[TimedBelief],
    writer: RecordingWriter,
) -> tuple[BeliefSeries, BeliefSeries]:
    """Copies all messages, and writes each new belief after the recorded one, or else before the next scan."""
    estimator, world = settings.estimator, load_world(settings.world)
    old, new = BeliefSeries(), BeliefSeries(estimator)
    stamps = [] if scans.stamps_ns is None else scans.stamps_ns.tolist()
    pending: list[tuple[Topic, Belief | Prediction]] = []  # of the last scan
    scan_published_ns = scan_logged_ns = 0

    def write_pending(logged_ns: int) -> None:
        for topic, message in pending:
            payload = message.model_copy(update={"seq": len(new.stamps) - 1}).encode()
            writer.write(topic, topic.key(alias), payload, logged_ns, logged_ns)
        pending.clear()

    for raw in recording.payloads():
        topic = topic_of(raw.key)
        if topic is None:  # not a message of presage
            continue
        if raw.key == SCAN.key(robot):
            write_pending(scan_logged_ns + 1)
        writer.write(topic, raw.key, raw.payload, raw.published_ns, raw.logged_ns)
        message = _decode(topic, raw) if raw.key in (SCAN.key(robot), BELIEF.key(robot)) else None
        if isinstance(message, Scan) and len(new.stamps) < len(stamps) and message.stamp_ns == stamps[len(new.stamps)]:
            scan_published_ns, scan_logged_ns = raw.published_ns, raw.logged_ns
            timed = next(localised)
            belief = belief_message(message, timed.posterior, estimator, world)
            new.add(belief, timed.update_ms)
            pending += [(PREDICTION, prediction_message(message, timed.posterior)), (BELIEF, belief)]
        elif isinstance(message, Belief):
            old.add(message, (raw.published_ns - scan_published_ns) * 1e-6)
            if new.stamps and message.stamp_ns == new.stamps[-1]:
                write_pending(raw.logged_ns + 1)
    write_pending(scan_logged_ns + 1)
    return old, new


def _decode(topic: Topic, raw: RawMessage) -> Stamped | None:
    try:
        return topic.message.decode(raw.payload)
    except DecodeError:
        return None
