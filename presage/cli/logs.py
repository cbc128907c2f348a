"""`presage import` and `localize`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from presage.terminal.options import (
    Config,
    EstimatorName,
    Json,
    ModelName,
    MountText,
    arguments,
    console,
    err_console,
    model_setting,
)

app = typer.Typer()

World = Annotated[
    str, typer.Option("--world", help="World name, world file, or ROS map.yaml. Defaults to the recorded world.")
]
WORLD_OF_LOG = "World or map in which the log was made; it is stored in the recording."


@app.command(rich_help_panel="Data", short_help="Localise a recording or log of any robot in a map.")
def localize(
    file: Annotated[
        Path, typer.Argument(help="A recording, a CARMEN log, a ROS 1 or 2 bag (file or folder), or an .npz file.")
    ],
    world: World = "",
    estimator: EstimatorName = "",
    model: ModelName = "",
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Output file NAME.csv, .json or .tum. Defaults to CSV on standard output."),
    ] = None,
    mode: Annotated[
        str,
        typer.Option(
            help="global: no start pose is known; track: from --initial-pose or the log's reference pose; single: each"
            " scan independently of the others."
        ),
    ] = "global",
    initial_pose: Annotated[
        str, typer.Option(help="Initial pose for mode track, x,y[,yaw_deg], in m and deg; any heading without yaw.")
    ] = "",
    start: Annotated[
        float | None, typer.Option(min=0.0, help="Skip the scans of this many seconds at the beginning.")
    ] = None,
    end: Annotated[
        float | None,
        typer.Option(help="Stop this many seconds after the first scan; a negative value counts from the last scan."),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Use only every N-th scan.")] = 1,
    mount: MountText = "",
    config: Config = None,
) -> None:
    """Run an estimator over a recording or a log offline, as fast as possible, and write one row for each scan.

    Columns: stamp (s), x, y (m), yaw (rad), covariance (cov_xx ... cov_yawyaw), free_energy (nats), state,
    probability (of an error below 0.2 m and 5 degrees), update_ms.
    Rows are written as they are computed, also before Ctrl-C (status 130). Section `estimator` of --config sets the
    estimator's parameters, and section `log` what a log does not state (docs/logs.md).

    Examples: `presage localize drive.bag --world map.yaml --out poses.csv`;
    `presage localize run.mcap --estimator particle-filter --out poses.json`;
    `presage localize scans.npz --world office --mount 0.1,0,0 --mode single`;
    `presage localize drive.log.bz2 --world map.yaml --start 60 --end 120` (the second minute);
    `presage localize drive.log.bz2 --world map.yaml --every 10 --mode track --initial-pose 3,1.5,90`.
    """
    from common.runtime.config import load_section, load_settings
    from presage.logs.options import LogSettings
    from presage.replay.localize import LocalizeOptions, build_estimator_options
    from presage.replay.localize import localize as run
    from services.estimator.paper.perception import Descent
    from services.estimator.settings import EstimatorSettings, ignored_settings

    chosen = arguments(config=config, estimator=estimator, initial_pose=initial_pose, **model_setting(model))
    settings, log = load_settings(EstimatorSettings, chosen), load_section(LogSettings, config, "log", mount=mount)
    for warning in ignored_settings(settings.estimator, settings.changed | ({"sigma"} if log.sigma else set())):
        err_console.print(f"warning: {warning}", highlight=False)
    estimator_options = build_estimator_options(
        file,
        world,
        settings.estimator,
        settings.model,
        settings.models,
        log.sigma or settings.sigma,
        settings.seed,
        settings.initial_pose,
        Descent(alpha=settings.alpha, iterations=settings.iterations),
    )
    options = LocalizeOptions.of(
        file,
        estimator_options,
        mode,
        log.frame,
        log.reading(),
        odometry=log.odometry,
        out=out,
        start=start,
        end=end,
        every=every,
    )
    run(options, err_console)


@app.command("import", rich_help_panel="Data", short_help="Convert a log to a recording.")
def import_(
    file: Annotated[Path, typer.Argument(help="A CARMEN log, a ROS 1 or 2 bag (file or folder), or an .npz file.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Recording to write, NAME.mcap. Defaults to the log's name, in this folder."),
    ] = None,
    world: Annotated[str, typer.Option("--world", help=WORLD_OF_LOG)] = "",
    mount: MountText = "",
    config: Config = None,
    json_file: Json = None,
) -> None:
    """Convert a log of another program to a recording with its scans, odometry and reference poses.

    The format is recognised from the content: CARMEN logs (.log, .clf, also .gz, .bz2, .xz), ROS 1 bags (.bag), ROS 2
    bags (a folder with metadata.yaml, .db3, .mcap) and .npz. Assumptions and omissions are reported; section `log` of
    --config states what the log does not (docs/logs.md). Reference poses become the topic truth.

    Examples: `presage import fr079.log.gz -o fr079.mcap --world fr079.yaml`;
    `presage import drive.bag`; `presage import bag_folder --mount 0.2,0,0`;
    `presage import gfs.log --config gfs.yaml`, which contains `log: {reference: true}`.
    """
    from common.runtime.config import load_section
    from presage.logs.importing import ImportOptions, import_command
    from presage.logs.options import LogSettings

    log = load_section(LogSettings, config, "log", mount=mount)
    target = out or Path(f"{file.resolve().name.split('.')[0]}.mcap")
    laser = log.frame == "laser"
    options = ImportOptions(file, target, log.reading(), world, laser=laser, rate=log.rate, sigma=log.sigma)
    import_command(options, json_file, console, err_console)
