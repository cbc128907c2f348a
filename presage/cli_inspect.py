"""Commands that look into a recording: plot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from presage.options import Json, console

app = typer.Typer()


@app.command()
def plot(
    file: Path,
    out: Annotated[Path | None, typer.Option(help="PNG; none: beside the recording.")] = None,
    json_file: Json = None,
) -> None:
    """Draw a recording and print its summary.

    Example: `presage plot recordings/run.mcap --out run.png`.
    """
    from presage.demo import plot_command  # noqa: PLC0415

    plot_command(file, out or file.with_suffix(".png"), json_file, console)
