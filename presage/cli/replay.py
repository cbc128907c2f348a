"""`presage replay` and `rerun`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.errors import UserError
from common.runtime.config import read_section
from presage.cli.session_options import chosen_link
from presage.terminal.options import (
    Config,
    EstimatorName,
    Json,
    ModelName,
    WorldName,
    console,
    given_options,
    model_setting,
)

app = typer.Typer()


@app.command(rich_help_panel="Record", short_help="Publish a recording again, or compare services on it.")
def replay(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="Recording to replay.")],
    only: Annotated[
        str, typer.Option(help="Topics to replay, separated by commas. Defaults to all except health.")
    ] = "",
    leave_out: Annotated[str, typer.Option("--except", help="Topics to leave out, separated by commas.")] = "",
    rate: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Replay speed: 1 keeps the original timing, 2 is twice as fast, 0 as fast as possible.",
        ),
    ] = None,
    start: Annotated[
        float | None,
        typer.Option(min=0.0, help="Start this many seconds after the beginning of the recording."),
    ] = None,
    end: Annotated[
        float | None,
        typer.Option(help="Stop this many seconds after the beginning; a negative value counts from the end."),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end, until Ctrl-C.")] = False,
    robot: Annotated[
        str, typer.Option(help="Publish under this robot name. Defaults to the robot of the recording.")
    ] = "",
    force: Annotated[
        bool, typer.Option("--force", help="Replay even if a live service publishes on the same keys.")
    ] = False,
    paused: Annotated[
        bool, typer.Option("--paused", help="Start paused, and pause at the end until Ctrl-C instead of exiting.")
    ] = False,
    with_services: Annotated[
        str,
        typer.Option(
            "--with",
            help="Services to run on the recorded inputs and compare with the recording: estimator[,controller].",
        ),
    ] = "",
    every_scan: Annotated[
        bool,
        typer.Option("--every-scan", help="With --with: also send the scans for which the recording has no belief."),
    ] = False,
    json_file: Json = None,
) -> None:
    """Publish a recording's messages again, with their original stamps; or compare services on recorded inputs.

    Keys in a terminal: space pauses, `.` steps one scan, left and right (or h and l) jump 5 s, up and down change the
    speed, q quits. The queryable presage/ROBOT/player offers the same over the bus.

    `--with estimator` needs only the file. It runs the named services in this process with the recorded configuration,
    world and model, on their recorded inputs, and compares their outputs with the recording. If the session ran in
    lockstep, the outputs must be identical; otherwise they must agree within 0.01 m and 0.01 rad while tracking,
    because a recording does not contain requests (`presage relocalise`), restarts, or what happened before it began.
    Exits with status 1 if they differ.

    Examples: `presage replay run.mcap --only scan,odom` (with `python -m services.estimator` beside it);
    `presage replay run.mcap --rate 4 --start 10 --end -5 --loop`; `presage replay run.mcap --except belief,prediction`;
    `presage replay run.mcap --robot ghost` (beside a live robot); `presage replay run.mcap --with estimator`.
    """
    from presage.replay.bus_replay import replay_options, run_replay

    bus_options = replay_options(only, leave_out, rate, start, end, robot, loop=loop, force=force, paused=paused)
    if not with_services:
        if json_file is not None or every_scan:
            raise UserError("--json and --every-scan go with --with: a plain replay compares nothing")
        run_replay(file, chosen_link(context, ("replay",), robot or "robot"), bus_options, console)
        return
    chosen = (rate, start, end)
    if only or leave_out or robot or force or loop or paused or any(value is not None for value in chosen):
        raise UserError(
            "--with sends all recorded inputs as fast as possible: leave out the options that choose what to replay"
        )
    from presage.replay.service_replay import ServiceReplayOptions, service_replay_command

    options = ServiceReplayOptions(file, with_services, every_scan)
    raise typer.Exit(service_replay_command(options, json_file, console))


@app.command(rich_help_panel="Data", short_help="Run another estimator over a recording and compare.")
def rerun(
    file: Annotated[Path, typer.Argument(help="Recording with the scans.")],
    estimator: EstimatorName = "",
    model: ModelName = "",
    world: WorldName = "",
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Recording to write. Defaults to FILE-ESTIMATOR.mcap beside the recording."),
    ] = None,
    config: Config = None,
    json_file: Json = None,
) -> None:
    """Run an estimator over a recording offline, as fast as possible, and compare it with the recorded estimator.

    Settings that are neither given nor in section `estimator` of --config keep their recorded values. The new
    recording contains all messages of the old one, and the new beliefs and predictions under presage/ROBOT-rerun/.
    Prints and draws (NEW.png, .pdf, data in .csv) the errors against the recorded truth, NEES, share of scans in state
    tracking, computing times, and the difference between the two estimators. Estimator paper assumes one heading; a
    warning says if the robot had another.

    Examples: `presage rerun run.mcap --estimator particle-filter --json pf.json`;
    `presage rerun run.mcap --model exact --out exact.mcap`;
    `presage rerun run.mcap --config global.yaml`, which contains `estimator: {prior: odometry, initial_pose: ''}`.
    """
    from presage.replay.rerun import RerunOptions, rerun_command

    chosen = {} if config is None else read_section(config, "estimator")
    chosen |= given_options(estimator=estimator, world=world, **model_setting(model))
    rerun_command(RerunOptions(file, chosen, out), json_file, console)
