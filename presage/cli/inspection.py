"""`presage info`, `echo`, `plot` and `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.bus.bus import DEFAULT_ENDPOINT
from presage.terminal.options import Connect, Json, RobotName, console, link_of

app = typer.Typer()


@app.command()
def info(
    file: Annotated[Path, typer.Argument(help="A recording, finished or not (.mcap, .mcap.active).")],
    check: Annotated[
        bool | None,
        typer.Option("--check/--no-check", help="Read every payload: gaps, bytes, checksums. None: up to 64 MiB."),
    ] = None,
    json_file: Json = None,
) -> None:
    """What is in a recording: time, topics, rates, gaps, drops, sizes, metadata, and whether it is whole.

    Gaps and missing messages are counted by the publishers' own sequence numbers. Ends with status 1 where the file
    is not whole.

    Examples: `presage info run.mcap`; `presage info long.mcap --check --json facts.json`;
    `presage info run.mcap.active` (unfinished: what can be read of it).
    """
    from presage.recordings.printing import info as show  # noqa: PLC0415

    raise typer.Exit(show(file, json_file, check, console))


@app.command()
def echo(
    source: Annotated[str, typer.Argument(help="A topic on the bus, or a recording.", metavar="TOPIC|FILE")],
    topic: Annotated[str | None, typer.Argument(help="Of a recording: this topic or key alone; none: all.")] = None,
    count: Annotated[int, typer.Option("-n", "--count", min=0, help="End after so many; 0: all, or Ctrl-C.")] = 0,
    start: Annotated[float, typer.Option(min=0.0, help="Of a recording: from so many s after its beginning.")] = 0.0,
    full: Annotated[bool, typer.Option("--full", help="Long arrays whole.")] = False,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Print messages, one JSON line each: of a topic as they come, or out of a recording, with key and time.

    The name of a topic means the bus; all else is a file (./belief is a file, belief a topic).

    Examples: `presage echo belief -n 1`; `presage echo scan --full -n 1 | jq .ranges`;
    `presage echo run.mcap`; `presage echo run.mcap belief -n 3 --start 10`;
    `presage echo run.mcap belief | jq .free_energy`.
    """
    from presage.recordings.printing import echo_either  # noqa: PLC0415

    link = link_of(connect, robot)
    raise typer.Exit(echo_either(link, source, topic, count, start, console, full=full))


@app.command()
def plot(
    file: Path,
    out: Annotated[Path | None, typer.Option(help="PNG; none: beside the recording.")] = None,
    json_file: Json = None,
) -> None:
    """Draw a recording and print its summary; of an unfinished one as far as it goes.

    Examples: `presage plot recordings/run.mcap --out run.png`; `presage plot run.mcap.active --json run.json`.
    """
    from presage.recordings.selection import stem_of  # noqa: PLC0415
    from presage.session.demo import plot_command  # noqa: PLC0415

    plot_command(file, out or file.with_name(stem_of(file) + ".png"), json_file, console)


@app.command()
def export(
    file: Annotated[Path, typer.Argument(help="A recording, finished or not.")],
    to: Annotated[str, typer.Option("--format", help="csv, tum or foxglove.")],
    out: Annotated[Path | None, typer.Option(help="Folder (csv, tum) or file; none: beside the recording.")] = None,
    arrays: Annotated[bool, typer.Option("--arrays", help="csv: arrays (ranges) too, in their own files.")] = False,
    localised_only: Annotated[
        bool, typer.Option("--localised-only", help="tum: beliefs in state tracking alone.")
    ] = False,
    robot: Annotated[str, typer.Option(help="Which robot; none: the recording's own.")] = "",
    force: Annotated[bool, typer.Option("--force", help="Write over what is there.")] = False,
    json_file: Json = None,
) -> None:
    """Give a recording to other programs.

    csv: a file a topic, a row a message, and a README of columns and units.
    tum: belief.tum, truth.tum, odom.tum, trajectories as evo reads them; stamps are the messages' own.
    foxglove: an MCAP file of Foxglove's schemas, which Foxglove and Lichtblick show as it is; docs/foxglove-layout.json
    is a layout for it. Its times are the recording's wall clock.

    Examples: `presage export run.mcap --format csv --out tables --arrays`;
    `presage export run.mcap --format tum --out run-tum`, then `evo_ape tum run-tum/truth.tum run-tum/belief.tum`;
    `presage export run.mcap --format foxglove --out view.mcap`.
    """
    from presage.recordings.export import Export, run_export  # noqa: PLC0415

    run_export(Export(file, to, out, robot, arrays, localised_only, force), json_file, console)
