"""`presage replay --with SERVICE`: runs a service on its recorded inputs and compares.

In lockstep: a scan is given when what the last one called for has come, so nothing is dropped. Of the recorded scans
those are given that the live estimator answered, unless all are asked for: what it never took, because a newer one had
come or because it was not there yet, is no part of what it believed. Not in a recording, and so not repeated: requests
(`presage localise`), a restart of the estimator, and what it had seen before the recorder came.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from common.bus.bus import open_bus
from common.errors import UserError
from common.messages.topics import SCAN
from common.versions import commit
from presage.replay.comparison import BIT_FOR_BIT, TOLERANCE_M, TOLERANCE_RAD, Outcome
from presage.replay.feed import Feed
from presage.replay.recorded_session import (
    SETTINGS,
    Unpacked,
    check_mount,
    estimator_settings,
    other_versions,
    recorded_settings,
    robot_of,
    world_file,
)
from presage.session.stack import Stack
from presage.terminal.output import check_file, write_json
from services.estimator.settings import EstimatorSettings
from services.recorder.reader import Recording, read_recording


@dataclass(frozen=True)
class ServiceReplayOptions:
    """What is asked for."""

    file: Path
    services: str = "estimator"  # comma-separated
    rate: float | None = None  # None: in lockstep
    every_scan: bool = False

    def names(self) -> tuple[str, ...]:
        """Of the services; raises UserError for one that cannot be run from a file."""
        names = tuple(dict.fromkeys(part.strip() for part in self.services.split(",") if part.strip()))
        if "estimator" not in names or set(names) - SETTINGS.keys():
            raise UserError(f"--with {self.services}: give estimator, or estimator,controller")
        return names


def service_replay_command(how: ServiceReplayOptions, json_file: Path | None, console: Console) -> int:
    """Run, say how it compares; 0 where it is as it must be."""
    check_file(json_file, "--json")
    outcome = run_service_replay(how, console)
    for line in words(outcome):
        console.print(line, highlight=False, soft_wrap=True)
    about = {"file": str(how.file), "services": how.names(), "rate": how.rate, "every_scan": how.every_scan}
    write_json(json_file, {**about, **outcome.as_dict(), "commit": commit(), "arguments": sys.argv[1:]})
    return 0 if outcome.good else 1


def run_service_replay(how: ServiceReplayOptions, console: Console) -> Outcome:
    """Raises UserError where the file does not hold what is needed, or a service ends."""
    names, recording = how.names(), read_recording(how.file)
    if recording.warning:
        print(f"warning: {recording.warning}", file=sys.stderr)
    robot = robot_of(recording)
    scans = recording.counts()[SCAN.key(robot)]
    if not scans:
        raise UserError(f"{how.file}: no scan in it")
    if imported := "log" in recording.metadata:
        if names != ("estimator",):
            raise UserError(f"{how.file}: an imported log has no goal that a controller could answer: --with estimator")
        how = replace(how, every_scan=True)  # nobody has answered any
    why = why_not_exact(recording, how)
    outcome = Outcome(not why, why, scans=scans, imported=imported)
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PRESAGE_")}
    clean["PRESAGE_LOSSLESS"] = "1"
    with tempfile.TemporaryDirectory(prefix="presage-") as folder, Stack(robot, quiet=True, environment=clean) as stack:
        config = configure(recording, names, Path(folder), outcome.notes)
        stack.start_router()
        for name in names:
            stack.start(name, "--config", str(config))
        with open_bus(stack.link()) as bus:
            with console.status(f"starting {', '.join(names)} as recorded"):
                stack.wait_alive(bus)
            feed = Feed(recording, bus, stack, outcome, rate=how.rate, every_scan=how.every_scan)
            feed.run(console)
    outcome.damaged = recording.problem  # found where it was read
    if lost := outcome.numbers.missing:
        outcome.notes.append(f"{lost} scans are missing from the recording by their numbers: what came of them is too")
    if not outcome.good:
        outcome.notes += differences(recording, names)
    return outcome


def configure(recording: Recording, names: tuple[str, ...], folder: Path, notes: list[str]) -> Path:
    """A file of settings, and beside it what they need; raises UserError where something is missing."""
    sections: dict[str, dict[str, Any]] = {}
    for name in names:
        recorded = recorded_settings(recording, name)
        if recorded is None and "log" in recording.metadata:
            if (world := world_file(recording, folder)) is None:
                raise UserError(f"{recording.path}: imported without a world: import it with --world")
            recorded = Unpacked({"world": str(world)})
            notes.append("an imported log: the estimator runs as it does by default")
        if recorded is None:
            raise UserError(
                f"{recording.path}: the {name}'s configuration was not recorded (was it alive then?); start one "
                f"yourself, and `presage replay {recording.path} --only scan,odom,goal` beside it"
            )
        unpacked = recorded
        if name == "estimator":
            imported = "log" in recording.metadata
            unpacked = estimator_settings(recording, folder, recorded.values, weights=not imported)
            notes += unpacked.notes
            check_mount(recording, EstimatorSettings(**unpacked.values))
        elif recorded.values.get("world") and (world := world_file(recording, folder)) is not None:
            unpacked = replace(recorded, values={**recorded.values, "world": str(world)})
        notes += recorded.notes
        sections[name] = dict(unpacked.values)
    if "controller" in sections:  # the pace is ours, and no belief is late
        sections["controller"]["belief_timeout"] = 60.0
    path = folder / "settings.yaml"
    path.write_text(yaml.safe_dump(sections), encoding="utf-8")
    return path


def why_not_exact(recording: Recording, how: ServiceReplayOptions) -> str:
    """Why equality to the last bit cannot be required; empty where it can."""
    if how.rate is not None or how.every_scan:
        return f"{'--every-scan' if how.rate is None else '--rate'} was given"
    estimator = recorded_settings(recording, "estimator")
    if estimator is not None and estimator.values.get("prior") == "command":
        return "with prior command a command races with the scan"
    pace = recorded_pace(recording)
    return "" if pace == "lockstep" else f"the session ran {f'at pace {pace}' if pace else 'at an unknown pace'}"


def recorded_pace(recording: Recording) -> str:
    """Of the simulator: realtime, fast, lockstep; empty where none was recorded."""
    try:
        return str(json.loads(recording.metadata["config:simulator"]["config"])["pace"])
    except (KeyError, ValueError, TypeError):
        return ""


def differences(recording: Recording, names: tuple[str, ...]) -> list[str]:
    """What is not as it was when recording, and may explain a difference."""
    found: dict[str, tuple[str, str]] = {}
    for name in names:
        found |= other_versions(recording, name)
    if not found:
        return []
    return ["recorded with " + ", ".join(f"{name} {was} (here {now})" for name, (was, now) in sorted(found.items()))]


def words(outcome: Outcome) -> list[str]:
    """For a terminal."""
    pairs, numbers = outcome.beliefs, outcome.beliefs.as_dict()
    lines = [f"scans: {outcome.given} of {outcome.scans} given"]
    if outcome.left_out:
        lines[0] += f"; {outcome.left_out} left out that the live estimator never answered (--every-scan gives them)"
    if outcome.unanswered:
        lines.append(f"[bold]{outcome.unanswered} scans were not answered in time now[/]")
    if pairs.compared:
        lines.append(
            f"beliefs: {pairs.equal} of {pairs.compared} equal bit for bit ({BIT_FOR_BIT}); greatest difference "
            f"{numbers['position_difference_max_m']:.3g} m, {numbers['heading_difference_max_rad']:.3g} rad"
        )
        if not outcome.lockstep:
            lines.append(
                f"  where both are tracking ({numbers['both_tracking']}): at most "
                f"{numbers['position_difference_tracking_max_m'] or 0:.3g} m, "
                f"{numbers['heading_difference_tracking_max_rad'] or 0:.3g} rad"
            )
    if left := pairs.unmatched()["recorded"]:
        lines.append(f"[bold]{left} recorded beliefs have none beside them now[/]")
    if outcome.commands.compared:
        commands = outcome.commands
        lines.append(
            f"commands: {commands.equal} of {commands.compared} equal; they differ by {commands.speed_most:.3g} m/s"
        )
    return [*lines, *outcome.notes, _verdict(outcome)]


def _verdict(outcome: Outcome) -> str:
    if outcome.damaged:
        return f"[bold red]the recording is damaged ({outcome.damaged}): what comes after that was not compared[/]"
    if outcome.imported:
        done = f"{outcome.beliefs.new_tracking} beliefs of {outcome.given} scans say tracking"
        return f"{done}; the log has none to compare with (`presage rerun` keeps them)"
    if outcome.lockstep and outcome.good:
        return "[bold green]the session ran in lockstep, and this is what it believed[/]"
    if outcome.lockstep:
        return "[bold red]the session ran in lockstep: the beliefs should be equal bit for bit, and are not[/]"
    limit = f"within {TOLERANCE_M:g} m and {TOLERANCE_RAD:g} rad once tracking"
    done = f"[bold green]{limit}[/]" if outcome.good else f"[bold red]not {limit}[/]"
    return f"{outcome.why}, so equality is not required: {done}"
