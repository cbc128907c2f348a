"""`presage info`, `plot` and `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from presage.terminal.options import Json, console

app = typer.Typer()


@app.command(rich_help_panel="Data", short_help="Contents of a recording, and whether it is complete.")
def info(
    file: Annotated[Path, typer.Argument(help="A recording, finished or not (.mcap, .mcap.active).")],
    check: Annotated[
        bool | None,
        typer.Option(
            "--check/--no-check",
            help="Read every message to check gaps, sizes and checksums. Defaults to --check for files up to 64 MiB.",
        ),
    ] = None,
    json_file: Json = None,
) -> None:
    """Show the contents of a recording: time, topics, rates, gaps, drops, sizes, metadata, and whether it is complete.

    Gaps and missing messages are counted from the publishers' sequence numbers. Exits with status 1 if the file is
    not complete.

    Examples: `presage info run.mcap`; `presage info long.mcap --check --json facts.json`;
    `presage info run.mcap.active` (an unfinished recording: shows the part that can be read).
    """
    from presage.recordings.printing import info as show

    raise typer.Exit(show(file, json_file, check, console))


@app.command(rich_help_panel="Data", short_help="Draw a recording and summarise it.")
def plot(
    file: Annotated[Path, typer.Argument(help="A recording, finished or not.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="PNG, PDF or SVG file to write. Defaults to the recording's name with .png."),
    ] = None,
    json_file: Json = None,
) -> None:
    """Draw a recording and print its summary; an unfinished recording is drawn as far as it can be read.

    Examples: `presage plot recordings/run.mcap --out run.png`; `presage plot run.mcap.active --json run.json`.
    """
    from presage.recordings.selection import stem_of
    from presage.recordings.session_figure import plot_command

    plot_command(file, out or file.with_name(stem_of(file) + ".png"), json_file, console)


@app.command(rich_help_panel="Data", short_help="Export to Foxglove, CSV or TUM.")
def export(
    file: Annotated[Path, typer.Argument(help="A recording, finished or not.")],
    to: Annotated[str, typer.Option("--format", help="Output format: csv, tum or foxglove.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Folder (csv, tum) or file (foxglove). Defaults to a name beside the recording."
        ),
    ] = None,
    arrays: Annotated[
        bool, typer.Option("--arrays", help="Also write arrays such as ranges, each to its own file (csv only).")
    ] = False,
    localised_only: Annotated[
        bool, typer.Option("--localised-only", help="Write only the beliefs in state tracking (tum only).")
    ] = False,
    robot: Annotated[str, typer.Option(help="Robot to export. Defaults to the robot of the recording.")] = "",
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    json_file: Json = None,
) -> None:
    """Export a recording to formats of other programs.

    - csv: one file for each topic, one row for each message, and a README of columns and units.
    - tum: the trajectories belief.tum, truth.tum and odom.tum for evo, with the stamps of the messages.
    - foxglove: an MCAP file that Foxglove and Lichtblick show directly, with wall clock times;
      docs/foxglove-layout.json is a layout for it.

    Examples: `presage export run.mcap --format csv --out tables --arrays`;
    `presage export run.mcap --format tum --out run-tum`, then `evo_ape tum run-tum/truth.tum run-tum/belief.tum`;
    `presage export run.mcap --format foxglove --out view.mcap`.
    """
    from presage.recordings.export import ExportOptions, run_export

    run_export(ExportOptions(file, to, out, robot, arrays, localised_only, force), json_file, console)
