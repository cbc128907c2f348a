"""`presage import`, `localize` and `map`."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from presage.logs.log import Reading
from presage.terminal.options import EstimatorName, Json, ModelName, Seed, console, err_console, with_options

app = typer.Typer()

PANEL = "What a log does not say itself"
Mount = Annotated[
    str,
    typer.Option(rich_help_panel=PANEL, help="Of the laser in base_link, x,y[,yaw_deg] (m, deg); none: as it says."),
]
UpsideDown = Annotated[
    bool | None, typer.Option(rich_help_panel=PANEL, help="The scanner hangs upside down; none: as tf says, else not.")
]
ScanTopic = Annotated[
    str, typer.Option(rich_help_panel=PANEL, help="Which of several scanners; of CARMEN the line, such as RLASER.")
]
OdomTopic = Annotated[
    str, typer.Option(rich_help_panel=PANEL, help="Which of several odometries; of CARMEN ODOM, not the scan's own.")
]
BaseFrame = Annotated[
    str, typer.Option(rich_help_panel=PANEL, help="The robot's frame in tf; none: odometry's, or base_link.")
]
Reference = Annotated[
    bool | None,
    typer.Option(
        rich_help_panel=PANEL,
        help="Its own poses in the map; none: where it states them; yes: corrected CARMEN poses too.",
    ),
]
ReferenceTopic = Annotated[
    str, typer.Option(rich_help_panel=PANEL, help="Poses in the map: Odometry or Pose(WithCovariance)Stamped.")
]
Angles = Annotated[
    str, typer.Option(rich_help_panel=PANEL, help="First and last beam in deg, such as -90,90, where it does not say.")
]
RangeMax = Annotated[
    float | None, typer.Option(min=0.1, max=1000, rich_help_panel=PANEL, help="A range from here on, m, is no return.")
]
Clock = Annotated[str, typer.Option(rich_help_panel=PANEL, help="Stamps of the sensor, or of the logger.")]
READING = (
    ("mount", Mount, ""), ("upside_down", UpsideDown, None), ("scan_topic", ScanTopic, ""),
    ("odom_topic", OdomTopic, ""), ("base_frame", BaseFrame, ""), ("reference", Reference, None),
    ("reference_topic", ReferenceTopic, ""), ("angles", Angles, ""), ("range_max", RangeMax, None),
    ("clock", Clock, "sensor"),
)  # fmt: skip


def reads_logs(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with these options, called with the ``reading`` that they ask for."""

    @wraps(command)
    def run(*args: Any, **kwargs: Any) -> Any:
        from presage.logs.options import reading_of  # noqa: PLC0415

        said = {name: kwargs.pop(name) for name, _, _ in READING}
        return command(*args, reading=reading_of(**said), **kwargs)

    return with_options(run, command, READING, without="reading")


@app.command()
@reads_logs
def localize(
    file: Annotated[Path, typer.Argument(help="A recording, CARMEN log, ROS 1 or 2 bag (a file, or a folder), .npz.")],
    world: Annotated[
        str,
        typer.Option(
            "--world", "--map", help="A shipped world, a world file, or a ROS map.yaml; none: the recording's."
        ),
    ] = "",
    estimator: EstimatorName = "precise",
    model: ModelName = "learned",
    models: Annotated[Path | None, typer.Option(help="Folder of weights; none: the shipped ones.")] = None,
    out: Annotated[Path | None, typer.Option(help="NAME.csv or NAME.json; none: CSV to standard output.")] = None,
    frame: Annotated[
        str, typer.Option(help="base_link or laser: whose pose; of an .npz also its own poses'.")
    ] = "base_link",
    mode: Annotated[
        str, typer.Option(help="global: nothing is known; track: from initial_pose, or the reference.")
    ] = "global",
    fresh: Annotated[bool, typer.Option("--fresh", help="Each scan on its own.")] = False,
    odometry: Annotated[bool, typer.Option(help="Use the file's odometry, where there is any.")] = True,
    start: Annotated[float | None, typer.Option(min=0.0, help="s from the first scan.")] = None,
    end: Annotated[float | None, typer.Option(help="s from the first scan; negative: from the last.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Use only each N-th scan.")] = 1,
    initial_pose: Annotated[str, typer.Option(help="x,y[,yaw_deg] (m, m, deg); for mode track.")] = "",
    sigma: Annotated[
        float | None, typer.Option(min=1e-4, max=10, help="The scanner's noise, m; none: as recorded, else 0.02.")
    ] = None,
    seed: Seed = 0,
    *,
    reading: Reading,
) -> None:
    """Run an estimator over a recording or a log, as fast as it goes; one row a scan.

    Rows are written as they are computed: after Ctrl-C the CSV holds those of the scans so far (status 130), and JSON
    says "complete": false. Progress goes to standard error. With `--start`, `--end` and `--every` the other scans are
    skipped; stamps and odometry stay the log's own. With `--start`, mode track begins at the reference there, or at
    `--initial-pose`.

    Columns: stamp (s), x, y (m), yaw (rad), covariance (cov_xx ... cov_yawyaw), free_energy (nats), state, update_ms.
    Examples: `presage localize scans.npz --world office --out poses.csv`;
    `presage localize run.mcap --estimator particle-filter --out poses.json`;
    `presage localize scans.npz --world office --fresh --frame laser`;
    `presage localize drive.bag --world office --mode track --initial-pose 3,1.5,90`;
    `presage localize drive.log.bz2 --map map.yaml --start 60 --end 120 --out minute.csv` (its second minute);
    `presage localize drive.log.bz2 --map map.yaml --every 10 --end -30` (each tenth scan, less the last 30 s).
    """
    from presage.replay.localize import Job, choice_of  # noqa: PLC0415
    from presage.replay.localize import localize as run  # noqa: PLC0415

    choice = choice_of(file, world, estimator, model, models, sigma, seed, initial_pose)
    job = Job.of(
        file, choice, mode, frame, reading, fresh=fresh, odometry=odometry, out=out, start=start, end=end, every=every
    )
    run(job, err_console)


@app.command("import")
@reads_logs
def import_(
    file: Annotated[Path, typer.Argument(help="CARMEN log, ROS 1 or 2 bag (a file, or a folder), or .npz.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="NAME.mcap; none: the log's name, here.")] = None,
    world: Annotated[str, typer.Option("--world", "--map", help="Of the log: stored with it. None: none.")] = "",
    robot: Annotated[str, typer.Option(help="Its name in the keys.")] = "robot",
    frame: Annotated[str, typer.Option(help="base_link or laser: whose poses the recording has.")] = "base_link",
    *,
    reading: Reading,
    rate: Annotated[float | None, typer.Option(min=0.01, max=1000, help="Hz, of an .npz without stamps.")] = None,
    sigma: Annotated[
        float | None, typer.Option(min=1e-4, max=10, help="The scanner's noise, m; none: unknown.")
    ] = None,
    json_file: Json = None,
) -> None:
    """Make a recording of a log of another program: scans, odometry, and where it has them reference poses.

    Formats are told by content: CARMEN logs (.log, .clf, also .gz, .bz2, .xz), ROS 1 bags (.bag), ROS 2 bags (a folder
    with metadata.yaml, .db3, .mcap), .npz (docs/logs.md). What was taken for granted or left out is said. The recording
    is like any other: info, replay, localize, rerun, plot, export and the live page take it. Reference poses stand in
    it as truth; they are as good as the log's own.

    Examples: `presage import fr079.log.gz -o fr079.mcap --world fr079.yaml`;
    `presage import drive.bag --scan-topic /scan_front`; `presage import bag_folder --mount 0.2,0,0 --no-reference`;
    `presage import scans.npz --frame laser`; `presage import gfs.log --reference` (its scans' poses are corrected).
    """
    from common.errors import UserError  # noqa: PLC0415
    from presage.logs.importing import Import, import_command  # noqa: PLC0415
    from presage.replay.bus_replay import checked_robot  # noqa: PLC0415

    if frame not in ("base_link", "laser"):
        raise UserError(f"no frame {frame!r}: choose base_link or laser")
    stem = file.resolve().name.split(".")[0]
    target = out or Path(f"{stem}.mcap")
    job = Import(file, target, reading, world, checked_robot(robot), frame == "laser", rate, sigma)
    import_command(job, json_file, console, err_console)


@app.command("map")
@reads_logs
def map_(
    log: Annotated[Path, typer.Argument(help="Recording or log with reference poses (docs/logs.md).")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="NAME.yaml; none: the log's name, here.")] = None,
    half: Annotated[str, typer.Option(help="first or second, of the drive; none: all of it.")] = "",
    cell: Annotated[float, typer.Option(min=0.005, max=1.0, help="Edge of a cell, m.")] = 0.05,
    *,
    reading: Reading,
) -> None:
    """A ROS map (map.yaml, .pgm) of a drive whose poses are known; this is no SLAM.

    Occupied where at least two scans ended, and 60 % of those that looked; free where one went through.
    Examples: `presage map run.mcap`; `presage map fr079.npz --mount 0,0,0 --half first -o first_half.yaml`, then
    `presage experiment real --log fr079.npz --mount 0,0,0 --map first_half.yaml`.
    """
    from presage.learning.map_of_log import Job, map_command  # noqa: PLC0415

    target = out or Path(f"{log.resolve().name.split('.')[0]}.yaml")
    map_command(Job(log, target, half, cell, reading), console, err_console)
