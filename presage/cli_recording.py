"""Commands that make recordings: record."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.bus import DEFAULT_ENDPOINT
from presage.options import Connect, RobotName

app = typer.Typer()


@app.command()
def record(
    out: Annotated[Path, typer.Option(help="Folder.")] = Path("recordings"),
    topics: Annotated[str, typer.Option(help="Comma-separated topic names; empty: all.")] = "",
    robot: RobotName = "robot",
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Record a running session to an MCAP file, until Ctrl-C.

    Examples: `presage record`; `presage record --out logs --topics scan,odom`.
    """
    from common.service import main as serve  # noqa: PLC0415
    from services.recorder.service import RecorderService  # noqa: PLC0415
    from services.recorder.settings import RecorderSettings  # noqa: PLC0415

    args = ["--directory", str(out), "--robot", robot, "--connect", connect]
    serve(RecorderSettings, RecorderService, args + (["--topics", topics] if topics else []))
