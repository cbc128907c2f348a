"""`presage record` and `recover`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.bus.bus import DEFAULT_ENDPOINT
from presage.terminal.options import Connect, RobotName, asked, console

app = typer.Typer()


@app.command()
def record(
    out: Annotated[Path, typer.Option(help="Folder.")] = Path("recordings"),
    topics: Annotated[str, typer.Option(help="Comma-separated topic names; empty: all.")] = "",
    split_minutes: Annotated[float, typer.Option(min=0.0, help="Of one part, each whole by itself; 0: one file.")] = 0,
    split_size: Annotated[float, typer.Option(min=0.0, help="MB of one part; 0: one file.")] = 0,
    weights: Annotated[bool, typer.Option(help="Store the estimator's weights, up to 16 MiB.")] = True,
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Record a running session to an MCAP file, until Ctrl-C.

    Examples: `presage record`; `presage record --out logs --topics scan,odom`;
    `presage record --split-minutes 10`.
    """
    from common.runtime.service import main as serve  # noqa: PLC0415
    from services.recorder.service import RecorderService  # noqa: PLC0415
    from services.recorder.settings import RecorderSettings  # noqa: PLC0415

    def make(settings: RecorderSettings) -> RecorderService:
        return RecorderService(settings, remote=False)  # the page's button is for the session's own recorder

    args = ["--directory", str(out), "--robot", robot, "--connect", connect]
    args += ["--split-minutes", str(split_minutes), "--split-size", str(split_size)]
    args += ["--weights" if weights else "--no-weights", *(["--topics", topics] if topics else [])]
    if (here := asked.get()).security is not None:
        args += ["--security", str(here.security), "--role", here.role]
    serve(RecorderSettings, make, args)


@app.command()
def recover(
    file: Annotated[Path, typer.Argument(help="NAME.mcap.active of a recorder that was killed, or a damaged file.")],
    out: Annotated[Path | None, typer.Option(help="The whole file; none: NAME.mcap, or NAME-recovered.mcap.")] = None,
) -> None:
    """Make a whole recording of what is readable, and say what is missing.

    Every complete chunk is taken, also behind a damaged one. An unfinished source is kept as NAME.mcap.torn.
    Examples: `presage recover recordings/run.mcap.active`; `presage recover damaged.mcap --out whole.mcap`.
    """
    from rich.progress import Progress  # noqa: PLC0415

    from services.recorder.recover import recover as run  # noqa: PLC0415

    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(file.name, total=1.0)
        found = run(file, out, on_progress=lambda done: bar.update(task, completed=done))
    console.print(*found.lines(), sep="\n", highlight=False, soft_wrap=True)
