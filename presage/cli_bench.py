"""Commands that measure."""

from __future__ import annotations

from typing import Annotated

import typer

from presage.options import Json, WorldName, console

app = typer.Typer(help="Measure, with a peer or a limit in the same run.", no_args_is_help=True)


@app.command("latency")
def bench_latency(
    scans: Annotated[int, typer.Option(min=10)] = 300,
    rate: Annotated[float, typer.Option(min=1, max=1000, help="Scans a second.")] = 15.0,
    beams: Annotated[int, typer.Option(help="Beams of a scan.")] = 622,
    json_file: Json = None,
) -> None:
    """From scan to command through the real services, beside zenoh's own round trip of the same bytes.

    Example: `presage bench latency --json latency.json`.
    """
    from presage.bench import bench_latency as run  # noqa: PLC0415

    raise typer.Exit(run(scans, rate, beams, json_file, console))


@app.command("localisation")
def bench_localisation(
    world: WorldName = "corridor",
    beams: Annotated[int, typer.Option(help="Beams of a scan.")] = 622,
    trials: Annotated[int, typer.Option(min=1)] = 100,
    scans: Annotated[int, typer.Option(min=1, help="Fresh scans of each trial.")] = 25,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    json_file: Json = None,
) -> None:
    """How often preset paper finds a standing robot from the map's centre.

    Example: `presage bench localisation --trials 20`.
    """
    from presage.bench_localisation import bench_localisation as run  # noqa: PLC0415

    raise typer.Exit(run(world, beams, trials, scans, seed, json_file, console))
