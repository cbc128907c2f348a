"""`presage record` and `recover`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from presage.cli.session_options import chosen_link
from presage.terminal.options import arguments, console

app = typer.Typer()


@app.command(rich_help_panel="Record", short_help="Record a session into an MCAP file, until Ctrl-C.")
def record(
    context: typer.Context,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the recording.")] = Path("recordings"),
    topics: Annotated[str, typer.Option(help="Topics to record, separated by commas. Defaults to all topics.")] = "",
    split_minutes: Annotated[
        float | None, typer.Option(min=0.0, help="Start a new complete file after this many minutes.")
    ] = None,
) -> None:
    """Record a running session into an MCAP file until Ctrl-C.

    Other settings come from environment variables, such as PRESAGE_SPLIT_SIZE=500 (MB) and PRESAGE_WEIGHTS=0.

    Examples: `presage record`; `presage record --out logs --topics scan,odom`;
    `presage record --split-minutes 10`.
    """
    from common.runtime.service import main as serve
    from services.recorder.service import RecorderService
    from services.recorder.settings import RecorderSettings

    def build_service(settings: RecorderSettings) -> RecorderService:
        # The live page controls the session's own recorder, not this one.
        return RecorderService(settings, serve_requests=False)

    link = chosen_link(context, ("recorder",))
    keys = None if link.security is None else link.security.folder.parent
    args = arguments(directory=out, robot=link.robot, connect=",".join(link.connect), security=keys)
    args += arguments(split_minutes=split_minutes, topics=topics)
    serve(RecorderSettings, build_service, args)


@app.command(rich_help_panel="Record", short_help="Repair an unfinished or damaged recording.")
def recover(
    file: Annotated[
        Path, typer.Argument(help="NAME.mcap.active, left by a recorder that was killed, or a damaged recording.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write. Defaults to NAME.mcap or NAME-recovered.mcap.")
    ] = None,
) -> None:
    """Make a complete recording from the readable parts of an unfinished or damaged one, and report what is missing.

    Every intact chunk is copied, also those after a damaged one. An unfinished source is kept as NAME.mcap.incomplete.

    Examples: `presage recover recordings/run.mcap.active`; `presage recover damaged.mcap --out whole.mcap`.
    """
    from rich.progress import Progress

    from services.recorder.recover import recover as run

    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(file.name, total=1.0)
        found = run(file, out, on_progress=lambda done: bar.update(task, completed=done))
    console.print(*found.lines(), sep="\n", highlight=False, soft_wrap=True)
