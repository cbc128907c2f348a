"""`presage export`: chooses the format."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from common.errors import UserError
from presage.recordings.selection import stem_of
from presage.terminal.output import check_file, write_json
from services.recorder.reader import Recording, read_recording

DEFAULT_SUFFIXES = {"csv": "-csv", "tum": "-tum", "foxglove": "-foxglove.mcap"}


@dataclass(frozen=True)
class ExportOptions:
    """Options of `presage export`."""

    file: Path
    format: str  # csv, tum or foxglove
    out: Path | None = None  # defaults to a name beside the recording
    robot: str = ""  # defaults to the robot of the recording
    arrays: bool = False
    localised_only: bool = False
    force: bool = False


def run_export(options: ExportOptions, json_file: Path | None, console: Console) -> None:
    """Exports the recording and prints what was written; raises UserError if that fails."""
    if options.format not in DEFAULT_SUFFIXES:
        raise UserError(f"no format {options.format!r}: choose {', '.join(DEFAULT_SUFFIXES)}")
    check_file(json_file, "--json")
    out = options.out or options.file.with_name(stem_of(options.file) + DEFAULT_SUFFIXES[options.format])
    recording = read_recording(options.file)
    start = time.monotonic()
    written = _write(options, recording, out, console)
    seconds = time.monotonic() - start
    if recording.warning:
        print(f"warning: {recording.warning}", file=sys.stderr)
    if undecodable := sum(recording.undecodable.values()):
        print(f"warning: {undecodable} messages could not be decoded and are left out", file=sys.stderr)
    unit = "messages" if options.format == "foxglove" else "rows"
    for name, rows in written.items():
        console.print(f"{rows:9d} {unit}  {name}", markup=False, highlight=False)
    console.print(f"written to {out} in {seconds:.1f} s", markup=False, highlight=False, soft_wrap=True)
    numbers = {
        "file": str(options.file),
        "format": options.format,
        "out": str(out),
        "written": written,
        "seconds": seconds,
    }
    write_json(json_file, {**numbers, "complete": recording.complete, "undecodable": undecodable})


def _write(options: ExportOptions, recording: Recording, out: Path, console: Console) -> dict[str, int]:
    """Writes the export and returns the number of rows or messages by name; imports only the format's module."""
    if options.format == "csv":
        from presage.recordings.csv_tables import export_csv

        return export_csv(recording, out, options.robot, console, arrays=options.arrays, force=options.force)
    if options.format == "tum":
        from presage.recordings.tum import export_tum

        only = options.localised_only
        return export_tum(recording, out, options.robot, console, localised_only=only, force=options.force)
    from presage.recordings.foxglove import export_foxglove

    return export_foxglove(recording, out, options.robot, console, force=options.force)
