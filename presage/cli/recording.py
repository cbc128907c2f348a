"""`presage record` and `recover`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.bus.bus import DEFAULT_ENDPOINT
from presage.terminal.options import Connect, RobotName, console, invocation

app = typer.Typer()


@app.command(rich_help_panel="Record", short_help="Record a session into an MCAP file, until Ctrl-C.")
def record(
    out: Annotated[Path, typer.Option(help="Folder for the recording.")] = Path("recordings"),
    topics: Annotated[str, typer.Option(help="Topics to record, separated by commas. Defaults to all topics.")] = "",
    split_minutes: Annotated[
        float, typer.Option(min=0.0, help="Start a new complete file after this many minutes. 0 writes one file.")
    ] = 0,
    split_size: Annotated[
        float, typer.Option(min=0.0, help="Start a new complete file after this many MB. 0 writes one file.")
    ] = 0,
    weights: Annotated[bool, typer.Option(help="Store the estimator's weights in the recording, up to 16 MiB.")] = True,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Record a running session into an MCAP file until Ctrl-C.

    Examples: `presage record`; `presage record --out logs --topics scan,odom`;
    `presage record --split-minutes 10`.
    """
    from common.runtime.service import main as serve  # noqa: PLC0415
    from services.recorder.service import RecorderService  # noqa: PLC0415
    from services.recorder.settings import RecorderSettings  # noqa: PLC0415

    def make(settings: RecorderSettings) -> RecorderService:
        # The live page controls the session's own recorder, not this one.
        return RecorderService(settings, remote=False)

    args = ["--directory", str(out), "--robot", robot, "--connect", connect]
    args += ["--split-minutes", str(split_minutes), "--split-size", str(split_size)]
    args += ["--weights" if weights else "--no-weights", *(["--topics", topics] if topics else [])]
    if (current := invocation.get()).security is not None:
        args += ["--security", str(current.security), "--role", current.role]
    serve(RecorderSettings, make, args)


@app.command(rich_help_panel="Record", short_help="Repair an unfinished or damaged recording.")
def recover(
    file: Annotated[
        Path, typer.Argument(help="NAME.mcap.active, left by a recorder that was killed, or a damaged recording.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="File to write. Defaults to NAME.mcap or NAME-recovered.mcap.")
    ] = None,
) -> None:
    """Make a complete recording from the readable parts of an unfinished or damaged one, and report what is missing.

    Every intact chunk is copied, also those after a damaged one. An unfinished source is kept as NAME.mcap.torn.

    Examples: `presage recover recordings/run.mcap.active`; `presage recover damaged.mcap --out whole.mcap`.
    """
    from rich.progress import Progress  # noqa: PLC0415

    from services.recorder.recover import recover as run  # noqa: PLC0415

    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(file.name, total=1.0)
        found = run(file, out, on_progress=lambda done: bar.update(task, completed=done))
    console.print(*found.lines(), sep="\n", highlight=False, soft_wrap=True)
