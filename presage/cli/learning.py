"""`presage train` and `map`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from common.errors import UserError
from presage.terminal.options import (
    Config,
    MountText,
    ScannerName,
    Seed,
    arguments,
    console,
    err_console,
)
from presage.terminal.output import output_folder

app = typer.Typer()


@app.command(rich_help_panel="Learn", short_help="Train the model of a world, or of a recorded drive.")
def train(
    world: Annotated[
        str,
        typer.Option(
            help="World name, world file, or ROS map.yaml. Defaults to corridor; with --from, to the drive alone."
        ),
    ] = "",
    drive: Annotated[
        Path | None,
        typer.Option("--from", help="Recording or log with reference poses whose scans train (precise only)."),
    ] = None,
    preset: Annotated[str, typer.Option(help="Estimator preset to train: precise or paper.")] = "precise",
    scanner: ScannerName = "",
    mount: MountText = "",
    beams: Annotated[int | None, typer.Option(min=2, help="Beams per scan. Defaults to the scanner's number.")] = None,
    samples: Annotated[
        int | None,
        typer.Option(
            min=10,
            help="Simulated scans. Defaults to 5000 or 10 per m² (precise), 13000 (paper) or 2000 (with --from).",
        ),
    ] = None,
    seed: Seed = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for the weights. Defaults to the folder the services read."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace weights of another world of the same name.")] = False,
    config: Config = None,
) -> None:
    """Train the generative model of a world, or of a recorded drive.

    The scans come from the running session if it has this scanner and world, otherwise from a simulator that the
    command starts. To resume an interrupted run of preset paper, give the same command again.

    With --from, the model learns from the scans of the drive at their reference poses. Every fifth scan is held out to
    measure the prediction error. With --world as well, scans simulated in that map cover the places not visited.
    Sections `train` and `log` of --config hold further parameters.

    Examples: `presage train --world my.yaml`; `presage train --preset paper --beams 622 --out mine`;
    `presage train --world my.yaml --scanner my-laser.yaml --mount 0.1,0,0`;
    `presage train --from drive.npz --mount 0,0,0 --world map.yaml --out mine`, then
    `presage localize drive.npz --mount 0,0,0 --world map.yaml --model mine`.
    """
    from common.runtime.config import load_section, load_settings
    from presage.learning import train_precise as precise
    from presage.learning.options import TrainSettings
    from presage.learning.train_drive import TrainDriveOptions, train_from_drive
    from presage.logs.options import LogSettings
    from presage.session.running_sessions import link_of
    from services.estimator.precise.learning.field_learning import Recipe
    from services.estimator.shared.model_folder import training_folder
    from services.simulator.settings import SimulatorSettings

    if preset not in ("precise", "paper"):
        raise UserError(f"no preset {preset!r}: choose precise or paper")
    if drive is not None and preset != "precise":
        raise UserError("--from trains preset precise only: the paper's decoder needs scans taken at one heading")
    folder, seed = out or training_folder(), seed or 0
    tuning = load_section(TrainSettings, config, "train")
    with output_folder(folder):
        if drive is not None:
            reading = load_section(LogSettings, config, "log", mount=mount).reading()
            recipe = Recipe(tuning.resolution or 0.05, seed=seed)
            train_from_drive(
                TrainDriveOptions(drive, world, folder, samples or 2000, recipe, tuning.share, reading, force=force),
                console,
            )
            return
        simulator = arguments(config=config, scanner=scanner, mount=mount, beams=beams)
        settings = load_settings(SimulatorSettings, simulator)
        chosen, link = settings.build_scanner(), link_of(settings.connect, settings.robot)
        world = world or settings.world
        if preset == "precise":
            recipe = Recipe(tuning.resolution or 0.04, seed=seed)
            precise.train_precise(
                precise.TrainPreciseOptions(world, chosen, tuple(simulator), folder, samples, recipe, force),
                link,
                console,
            )
        else:
            from presage.learning import train_paper as paper  # imports torch, which need not be installed
            from services.estimator.paper.training import TrainingParameters

            parameters = TrainingParameters(tuning.epochs, tuning.batch, tuning.learning_rate, seed)
            options = paper.TrainPaperOptions(
                world, preset, chosen, tuple(simulator), folder, samples or 13_000, parameters
            )
            paper.train(options, link, console)
    # Without --scanner, `presage up` would simulate the default one; without --model, it looks in the default folder.
    estimator = "" if preset == "precise" else preset
    use = ["presage", "up", *arguments(world=world, estimator=estimator, model=out, scanner=scanner, config=config)]
    console.print("use it with:", shlex.join(use), highlight=False, soft_wrap=True)


@app.command("map", rich_help_panel="Learn", short_help="Build a ROS map from a drive.")
def map_(
    log: Annotated[Path, typer.Argument(help="A recording or log (docs/logs.md).")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Map to write, NAME.yaml. Defaults to the log's name, in this folder."),
    ] = None,
    half: Annotated[
        str, typer.Option(help="Half of the drive to use: first or second. Defaults to the whole drive.")
    ] = "",
    cell: Annotated[float, typer.Option(min=0.005, max=1.0, help="Edge length of a cell, m.")] = 0.05,
    poses: Annotated[
        str, typer.Option(help="slam: computed from the scans and odometry; reference: the log's own.")
    ] = "slam",
    odometry: Annotated[bool, typer.Option(help="Whether slam uses the log's odometry.")] = True,
    refine: Annotated[
        str, typer.Option(help="Rough map or floor plan whose frame and unvisited parts the new map keeps.")
    ] = "",
    learn: Annotated[bool, typer.Option(help="Whether to learn the model of preset precise as well.")] = True,
    models: Annotated[
        Path | None, typer.Option(help="Folder for its weights. Defaults to the folder the services read.")
    ] = None,
    mount: MountText = "",
    config: Config = None,
) -> None:
    """Build a ROS map from a drive: NAME.yaml and .pgm, the trajectory NAME.tum and a picture NAME.png.

    The poses come from the scans themselves (SLAM), or with `--poses reference` from the log. The model that predicts
    the scans is learned at these poses, so that the map can be used at once.

    With --refine, the new map has the frame of a rough one, such as a ROS map of 5 cm cells or a floor plan without
    furniture, and its cells where the drive saw nothing.

    A cell is occupied if beams of at least two scans ended in it, and of at least 60 % of the scans that observed it.
    It is free if a beam passed through it, otherwise unknown.

    Examples: `presage map run.mcap -o here.yaml`, then `presage up --no-simulator --world here.yaml` with the robot, or
    `presage up --world here.yaml --model exact` in simulation;
    `presage map run.mcap --refine rough.yaml -o fine.yaml`;
    `presage map fr079.npz --mount 0,0,0 --poses reference --half first --no-learn -o first_half.yaml`, then
    `presage experiment real --log fr079.npz --mount 0,0,0 --world first_half.yaml`.
    """
    from common.runtime.config import load_section
    from presage.learning.map_of_log import MapOptions, map_command
    from presage.logs.options import LogSettings
    from services.estimator.shared.model_folder import training_folder

    folder = (models or training_folder()) if learn else None
    target = out or Path(f"{log.resolve().name.split('.')[0]}.yaml")
    reading = load_section(LogSettings, config, "log", mount=mount).reading()
    options = MapOptions(log, target, half, cell, reading, poses, odometry, refine, folder)
    map_command(options, console, err_console)
