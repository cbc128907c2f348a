"""Commands that bring a recording back to life: replay."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.bus import DEFAULT_ENDPOINT
from presage.options import Connect, console, link_of

app = typer.Typer()


@app.command()
def replay(
    file: Path,
    only: Annotated[str, typer.Option(help="Comma-separated topic names; empty: all but health.")] = "",
    rate: Annotated[
        float, typer.Option(min=0.0, help="1 is the original timing, 2 twice as fast, 0 as fast as it goes.")
    ] = 1.0,
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Put a recording's bytes back on their keys.

    Examples: `presage replay run.mcap --only scan,odom` (with `python -m services.estimator` beside it);
    `presage replay run.mcap --rate 4`.
    """
    from presage.replaying import run_replay  # noqa: PLC0415

    run_replay(file, link_of(connect, "replay"), only, rate, console)
