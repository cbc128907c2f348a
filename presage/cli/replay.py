"""`presage replay` and `rerun`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.bus.bus import DEFAULT_ENDPOINT
from common.errors import UserError
from presage.terminal.options import Connect, Json, console, link_of

app = typer.Typer()


@app.command()
def replay(
    file: Path,
    only: Annotated[str, typer.Option(help="Comma-separated topic names; empty: all but health.")] = "",
    leave_out: Annotated[str, typer.Option("--except", help="Comma-separated topic names to leave out.")] = "",
    rate: Annotated[
        float | None, typer.Option(min=0.0, help="1 is the original timing, 2 twice as fast, 0 as fast as it goes.")
    ] = None,
    start: Annotated[float | None, typer.Option(min=0.0, help="s from the recording's beginning.")] = None,
    end: Annotated[float | None, typer.Option(help="s from its beginning; negative: from its end.")] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin anew at the end, until Ctrl-C.")] = False,
    robot: Annotated[str, typer.Option(help="Another robot's name in the keys; empty: the recorded one.")] = "",
    force: Annotated[bool, typer.Option("--force", help="Beside a live publisher of the same keys too.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Begin paused.")] = False,
    stay: Annotated[bool, typer.Option("--stay", help="Stay at the end, paused, until Ctrl-C.")] = False,
    with_services: Annotated[
        str, typer.Option("--with", help="estimator[,controller]: start them here, as recorded, and compare.")
    ] = "",
    every_scan: Annotated[
        bool, typer.Option("--every-scan", help="--with: also scans that the live estimator did not answer.")
    ] = False,
    json_file: Json = None,
    connect: Connect = DEFAULT_ENDPOINT,
) -> None:
    """Put a recording's bytes back on their keys, with their own stamps; or replay it to services started for it.

    While it runs, in a terminal: space pauses, `.` steps one scan, left and right (h, l) go 5 s, up and down change the
    rate, q quits. The queryable presage/ROBOT/player does the same over the bus.

    `--with estimator` needs nothing but the file: a router and the services named run here as they were configured,
    over the recorded world and model, hear what they heard, and what they say is compared with the recording. Each scan
    waits for the belief of the last (unless `--rate` is given). Where the session ran in lockstep both must be equal
    bit for bit; else, once tracking, within 0.01 m and 0.01 rad: a recording does not hold requests (`presage
    localise`), restarts, or what was seen before the recorder came. The status is 1 where they are not.

    Examples: `presage replay run.mcap --only scan,odom` (with `python -m services.estimator` beside it);
    `presage replay run.mcap --rate 4 --start 10 --end -5 --loop`; `presage replay run.mcap --except belief,prediction`;
    `presage replay run.mcap --robot ghost` (beside a live robot); `presage replay run.mcap --with estimator`.
    """
    from presage.replay.bus_replay import choice_of, run_replay  # noqa: PLC0415

    choice = choice_of(only, leave_out, rate, start, end, robot, loop=loop, force=force, paused=paused, stay=stay)
    if not with_services:
        if json_file is not None or every_scan:
            raise UserError("--json and --every-scan go with --with: a plain replay compares nothing")
        run_replay(file, link_of(connect, "robot", "replay"), choice, console)
        return
    if only or leave_out or robot or force or loop or paused or stay or start is not None or end is not None:
        raise UserError("--with replays the whole of what those services heard: it takes no other choice than --rate")
    from presage.replay.service_replay import Again, again_command  # noqa: PLC0415

    how = Again(file, with_services, rate, every_scan=every_scan)
    raise typer.Exit(again_command(how, json_file, console))


@app.command()
def rerun(
    file: Path,
    estimator: Annotated[
        str | None, typer.Option(help="precise, paper, particle-filter or amcl-defaults; none: the recorded one.")
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="Of precise: learned, exact, or a file of weights; none: the recorded one.")
    ] = None,
    models: Annotated[Path | None, typer.Option(help="Folder of weights; none: the recorded or shipped ones.")] = None,
    prior: Annotated[
        str | None, typer.Option(help="Of motion: motion, odometry, command; none: the recorded one.")
    ] = None,
    initial_pose: Annotated[str | None, typer.Option(help="x,y[,yaw_deg]; '' is nothing known; none: as then.")] = None,
    sigma: Annotated[float | None, typer.Option(help="The scanner's noise, m; none: the recorded one.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of what is drawn; none: the recorded one.")] = None,
    world: Annotated[str | None, typer.Option(help="A shipped world or a file; none: the recorded one.")] = None,
    out: Annotated[Path | None, typer.Option(help="NEW.mcap; none: FILE-ESTIMATOR.mcap beside the recording.")] = None,
    json_file: Json = None,
) -> None:
    """Run an estimator over a recording offline, as fast as it goes; old and new beliefs in one new recording.

    The new recording has every byte of the old one, and the new beliefs and predictions under presage/ROBOT-rerun/.
    Printed and drawn (NEW.png, .pdf, data in .csv): errors against the recorded truth, NEES, share tracking, times, the
    difference between the two. What is not said on the command line is as it was recorded.

    Examples: `presage rerun run.mcap --estimator particle-filter --json pf.json`;
    `presage rerun run.mcap --model exact --out exact.mcap`; `presage rerun run.mcap --prior odometry`;
    `presage rerun run.mcap --estimator precise --initial-pose ''` (from nothing known).
    """
    from presage.replay.rerun import Rerun, rerun_command  # noqa: PLC0415

    said = {
        "estimator": estimator, "model": model, "models": str(models) if models else None, "prior": prior,
        "initial_pose": initial_pose, "sigma": sigma, "seed": seed, "world": world,
    }  # fmt: skip
    rerun_command(Rerun(file, {k: v for k, v in said.items() if v is not None}, out), json_file, console)
