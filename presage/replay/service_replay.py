"""`presage replay --with SERVICE`: runs services on their recorded inputs, in this process, and compares.

A scan is sent when the outputs for the one before have been computed, so nothing is dropped. Only the scans that the
live estimator answered are sent, unless `every_scan` is set: a scan that it skipped, because a newer one had come or
because it was not running yet, had no influence on its beliefs. A recording does not contain requests
(`presage relocalise`), restarts of the estimator, and what happened before the recording began; these are not repeated.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from common.errors import UserError
from common.log import set_up_logging
from common.messages.topics import BELIEF, CMD_VEL, SCAN
from common.names import split_names
from common.runtime.service import Service
from common.versions import commit
from presage.recordings.selection import robot_of
from presage.replay.feed import ScanFeed
from presage.replay.in_process import InProcessServices
from presage.replay.recorded_settings import (
    SETTINGS,
    estimator_settings,
    other_versions,
    recorded_settings,
    settings_with,
    world_file,
)
from presage.replay.replay_outcome import COMPARED_FIELDS, TOLERANCE_M, TOLERANCE_RAD, ReplayOutcome
from presage.terminal.output import check_file, write_json
from services.controller.service import ControllerService
from services.controller.settings import ControllerSettings
from services.estimator.service import EstimatorService
from services.estimator.settings import EstimatorSettings
from services.recorder.reader import Recording, read_recording

CAUSES = (
    "check whether a service ran before the recording began, was restarted, or received a request such as `presage "
    "relocalise`, because these are not repeated"
)


@dataclass(frozen=True)
class ServiceReplayOptions:
    """Options of `presage replay --with`."""

    file: Path
    services: str = "estimator"  # comma-separated
    every_scan: bool = False

    def names(self) -> tuple[str, ...]:
        """Names of the services; raises UserError for one that cannot be run on a recording."""
        names = tuple(dict.fromkeys(split_names(self.services)))
        if "estimator" not in names or set(names) - SETTINGS.keys():
            raise UserError(f"--with {self.services}: give estimator, or estimator,controller")
        return names


def service_replay_command(options: ServiceReplayOptions, json_file: Path | None, console: Console) -> int:
    """Runs the services, prints the comparison, and returns 0 if the results agree, else 1."""
    check_file(json_file, "--json")
    set_up_logging("error")
    outcome = run_service_replay(options, console)
    for line in describe(outcome):
        console.print(line, highlight=False, soft_wrap=True)
    about = {"file": str(options.file), "services": options.names(), "every_scan": options.every_scan}
    write_json(json_file, {**about, **outcome.as_dict(), "commit": commit(), "arguments": sys.argv[1:]})
    return 0 if outcome.agrees else 1


def run_service_replay(options: ServiceReplayOptions, console: Console) -> ReplayOutcome:
    """Runs the services on the recorded inputs; raises UserError if the recording lacks something."""
    names, recording = options.names(), read_recording(options.file)
    if recording.warning:
        print(f"warning: {recording.warning}", file=sys.stderr)
    robot = robot_of(recording)
    scans = recording.counts[SCAN.key(robot)]
    if not scans:
        raise UserError(f"{options.file}: no scan in it")
    if "log" in recording.metadata:
        raise UserError(
            f"{options.file}: an imported log has no beliefs to compare with; run an estimator on it with: presage "
            f"localize {options.file}"
        )
    tolerance_reason = find_tolerance_reason(recording, options)
    outcome = ReplayOutcome(not tolerance_reason, tolerance_reason, scans=scans)
    with tempfile.TemporaryDirectory(prefix="presage-") as folder:
        services = build_services(recording, names, Path(folder), outcome.notes)
        outputs = {BELIEF, CMD_VEL} if "controller" in names else {BELIEF}
        with console.status(f"starting {', '.join(names)} as recorded"):
            running = InProcessServices(services, robot)
        ScanFeed(recording, running, outputs, outcome, every_scan=options.every_scan).run(console)
    outcome.damaged = recording.problem  # only known after reading
    if lost := outcome.numbers.missing:
        outcome.notes.append(
            f"{lost} scans are missing in the recording, as their sequence numbers show: results may differ after them"
        )
    if not outcome.agrees:
        outcome.notes += version_differences(recording, names)
    return outcome


def build_services(recording: Recording, names: tuple[str, ...], folder: Path, notes: list[str]) -> list[Service]:
    """The services with their recorded settings; writes the files that they need into ``folder``.

    Adds to ``notes``. Raises UserError if something is missing in the recording.
    """
    services: list[Service] = []
    for name in names:
        recorded = recorded_settings(recording, name)
        if recorded is None:
            raise UserError(
                f"{recording.path}: the {name}'s configuration was not recorded (it may not have been running); start "
                f"the {name} yourself, and run `presage replay {recording.path} --only scan,odom,goal` beside it"
            )
        values: dict[str, Any] = recorded.values
        if name == "estimator" and "estimator" not in values:  # a setting that every estimator of presage has
            raise UserError(
                f"{recording.path}: the recording was made with another program as estimator, which cannot be run "
                f"here; `presage rerun {recording.path}` compares it with an estimator of presage"
            )
        notes += recorded.notes
        if name == "estimator":
            if values.get("learn") == "refine":  # what it learned was recorded
                values = {**values, "learn": "follow"}
            unpacked = estimator_settings(recording, folder, values)
            notes += unpacked.notes
            services.append(EstimatorService(settings_with(EstimatorSettings, unpacked.values)))
        else:
            if values.get("world") and (world := world_file(recording, folder)) is not None:
                values = {**values, "world": str(world)}
            services.append(ControllerService(settings_with(ControllerSettings, values)))
    return services


def find_tolerance_reason(recording: Recording, options: ServiceReplayOptions) -> str:
    """Returns why the results may differ by a tolerance; an empty string if they must be identical."""
    if options.every_scan:
        return "--every-scan was given"
    estimator = recorded_settings(recording, "estimator")
    if estimator is not None and estimator.values.get("prior") == "command":
        return "with prior command, the order of commands and scans is not reproducible"
    pace = recorded_pace(recording)
    return "" if pace == "lockstep" else f"the session ran {f'at pace {pace}' if pace else 'at an unknown pace'}"


def recorded_pace(recording: Recording) -> str:
    """The recorded pace of the simulator: realtime, fast or lockstep; "" if none was recorded."""
    try:
        return str(json.loads(recording.metadata["config:simulator"]["config"])["pace"])
    except (KeyError, ValueError, TypeError):
        return ""


def version_differences(recording: Recording, names: tuple[str, ...]) -> list[str]:
    """Notes on differences between the software versions of the recording and those here."""
    found: dict[str, tuple[str, str]] = {}
    for name in names:
        found |= other_versions(recording, name)
    if not found:
        return []
    return ["recorded with " + ", ".join(f"{name} {was} (here {now})" for name, (was, now) in sorted(found.items()))]


def describe(outcome: ReplayOutcome) -> list[str]:
    """The result of the comparison, as lines with rich markup."""
    pairs, numbers = outcome.beliefs, outcome.beliefs.as_dict()
    lines = [f"scans: {outcome.sent} of {outcome.scans} sent"]
    if outcome.left_out:
        lines[0] += f"; {outcome.left_out} left out, which the live estimator did not answer (--every-scan sends them)"
    if outcome.unanswered:
        lines.append(f"[bold]{outcome.unanswered} scans were not answered in this replay[/]")
    if pairs.compared:
        lines.append(
            f"beliefs: {pairs.equal} of {pairs.compared} identical ({COMPARED_FIELDS}); maximum difference "
            f"{numbers['position_difference_max_m']:.3g} m, {numbers['heading_difference_max_rad']:.3g} rad"
        )
        if not outcome.lockstep:
            lines.append(
                f"  while both are tracking ({numbers['both_tracking']}): at most "
                f"{numbers['position_difference_tracking_max_m'] or 0:.3g} m, "
                f"{numbers['heading_difference_tracking_max_rad'] or 0:.3g} rad"
            )
    if left := pairs.unmatched()["recorded"]:
        lines.append(f"[bold]{left} recorded beliefs have no counterpart in this replay[/]")
    if outcome.commands.compared:
        commands = outcome.commands
        lines.append(
            f"commands: {commands.equal} of {commands.compared} identical; maximum difference "
            f"{commands.max_speed_difference:.3g} m/s or rad/s"
        )
    return [*lines, *outcome.notes, _verdict(outcome)]


def _verdict(outcome: ReplayOutcome) -> str:
    if outcome.damaged:
        return f"[bold red]the recording is damaged ({outcome.damaged}): what comes after that was not compared[/]"
    if outcome.lockstep and outcome.agrees:
        return "[bold green]the session ran in lockstep, and the results are identical[/]"
    if outcome.lockstep:
        return f"[bold red]the session ran in lockstep: the results should be identical, but are not[/]; {CAUSES}"
    limit = f"within {TOLERANCE_M:g} m and {TOLERANCE_RAD:g} rad while tracking"
    agreement = f"[bold green]{limit}[/]" if outcome.agrees else f"[bold red]not {limit}[/]; {CAUSES}"
    return f"{outcome.tolerance_reason}, so the results need not be identical: {agreement}"
