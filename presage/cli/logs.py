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

PANEL = "Properties of the log that the file does not state"
Mount = Annotated[
    str,
    typer.Option(
        rich_help_panel=PANEL,
        help="Pose of the laser in base_link, x,y[,yaw_deg], in m and deg. Defaults to the mount stated in the log.",
    ),
]
UpsideDown = Annotated[
    bool | None,
    typer.Option(
        rich_help_panel=PANEL,
        help="Whether the scanner is mounted upside down. Defaults to what tf states, otherwise no.",
    ),
]
ScanTopic = Annotated[
    str,
    typer.Option(
        rich_help_panel=PANEL,
        help="Scan topic to read if there are several scanners; in a CARMEN log the type of line, such as RLASER.",
    ),
]
OdomTopic = Annotated[
    str,
    typer.Option(
        rich_help_panel=PANEL,
        help="Odometry topic to read if there are several; in a CARMEN log, ODOM reads the ODOM lines instead of the"
        " odometry in the scan lines.",
    ),
]
BaseFrame = Annotated[
    str,
    typer.Option(
        rich_help_panel=PANEL,
        help="Frame of the robot in tf. Defaults to the child frame of the odometry, otherwise base_link.",
    ),
]
Reference = Annotated[
    bool | None,
    typer.Option(
        rich_help_panel=PANEL,
        help="Whether to read reference poses. Defaults to reading those that the log marks as such; --reference"
        " also takes the poses of corrected CARMEN scans.",
    ),
]
ReferenceTopic = Annotated[
    str,
    typer.Option(
        rich_help_panel=PANEL,
        help="Topic of the reference poses in the map: Odometry, PoseStamped or PoseWithCovarianceStamped.",
    ),
]
Angles = Annotated[
    str,
    typer.Option(
        rich_help_panel=PANEL,
        help="Angles of the first and last beam in deg, such as -90,90, if the log does not state them.",
    ),
]
RangeMax = Annotated[
    float | None,
    typer.Option(
        min=0.1, max=1000, rich_help_panel=PANEL, help="Treat ranges from this value on, m, as beams without return."
    ),
]
Clock = Annotated[str, typer.Option(rich_help_panel=PANEL, help="Clock of the stamps to use: sensor or logger.")]
READING_OPTIONS = (
    ("mount", Mount, ""),
    ("upside_down", UpsideDown, None),
    ("scan_topic", ScanTopic, ""),
    ("odom_topic", OdomTopic, ""),
    ("base_frame", BaseFrame, ""),
    ("reference", Reference, None),
    ("reference_topic", ReferenceTopic, ""),
    ("angles", Angles, ""),
    ("range_max", RangeMax, None),
    ("clock", Clock, "sensor"),
)


def reads_logs(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options that describe a log to a command, which receives them as its parameter ``reading``."""

    @wraps(command)
    def run(*args: Any, **kwargs: Any) -> Any:
        from presage.logs.options import reading_of  # noqa: PLC0415

        options = {name: kwargs.pop(name) for name, _, _ in READING_OPTIONS}
        return command(*args, reading=reading_of(**options), **kwargs)

    return with_options(run, command, READING_OPTIONS, without="reading")


@app.command(rich_help_panel="Offline", short_help="Localise a recording or log of any robot in a map.")
@reads_logs
def localize(
    file: Annotated[
        Path, typer.Argument(help="A recording, a CARMEN log, a ROS 1 or 2 bag (file or folder), or an .npz file.")
    ],
    world: Annotated[
        str,
        typer.Option(
            "--world",
            "--map",
            help="World name, world file, or ROS map.yaml. Defaults to the world stored in the recording.",
        ),
    ] = "",
    estimator: EstimatorName = "precise",
    model: ModelName = "learned",
    models: Annotated[Path | None, typer.Option(help="Folder of weights. Defaults to the shipped weights.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output file NAME.csv or NAME.json. Defaults to CSV on standard output.")
    ] = None,
    frame: Annotated[
        str,
        typer.Option(help="Frame whose pose is estimated, base_link or laser; for .npz also the frame of its poses."),
    ] = "base_link",
    mode: Annotated[
        str,
        typer.Option(
            help="global localises without a start pose; track starts at --initial-pose, or at the reference pose."
        ),
    ] = "global",
    fresh: Annotated[bool, typer.Option("--fresh", help="Localise each scan independently of the others.")] = False,
    odometry: Annotated[bool, typer.Option(help="Use the odometry of the file, if it has any.")] = True,
    start: Annotated[
        float | None, typer.Option(min=0.0, help="Skip the scans of this many seconds at the beginning.")
    ] = None,
    end: Annotated[
        float | None,
        typer.Option(help="Stop this many seconds after the first scan; a negative value counts from the last scan."),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Use only every N-th scan.")] = 1,
    initial_pose: Annotated[str, typer.Option(help="Initial pose for mode track, x,y[,yaw_deg], in m and deg.")] = "",
    sigma: Annotated[
        float | None,
        typer.Option(
            min=1e-4, max=10, help="Range noise of the scanner, m. Defaults to the recorded value, else 0.02."
        ),
    ] = None,
    seed: Seed = 0,
    *,
    reading: Reading,
) -> None:
    """Run an estimator over a recording or a log offline, as fast as possible, and write one row for each scan.

    Rows are written as they are computed: after Ctrl-C (status 130) the CSV contains the scans so far, and the JSON
    has "complete": false. Progress goes to standard error. `--start`, `--end` and `--every` select scans; stamps and
    odometry keep the values of the log. With `--start`, mode track begins at `--initial-pose`, or at the reference
    pose at that time.

    Columns: stamp (s), x, y (m), yaw (rad), covariance (cov_xx ... cov_yawyaw), free_energy (nats), state, update_ms.

    Examples: `presage localize scans.npz --world office --out poses.csv`;
    `presage localize run.mcap --estimator particle-filter --out poses.json`;
    `presage localize scans.npz --world office --fresh --frame laser`;
    `presage localize drive.bag --world office --mode track --initial-pose 3,1.5,90`;
    `presage localize drive.log.bz2 --map map.yaml --start 60 --end 120 --out minute.csv` (the second minute);
    `presage localize drive.log.bz2 --map map.yaml --every 10 --end -30` (every tenth scan, without the last 30 s).
    """
    from presage.replay.localize import LocalizeOptions, choice_of  # noqa: PLC0415
    from presage.replay.localize import localize as run  # noqa: PLC0415

    choice = choice_of(file, world, estimator, model, models, sigma, seed, initial_pose)
    job = LocalizeOptions.of(
        file, choice, mode, frame, reading, fresh=fresh, odometry=odometry, out=out, start=start, end=end, every=every
    )
    run(job, err_console)


@app.command("import", rich_help_panel="Offline", short_help="Convert a log to a recording.")
@reads_logs
def import_(
    file: Annotated[Path, typer.Argument(help="A CARMEN log, a ROS 1 or 2 bag (file or folder), or an .npz file.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Recording to write, NAME.mcap. Defaults to the log's name, in this folder."),
    ] = None,
    world: Annotated[
        str,
        typer.Option("--world", "--map", help="World or map in which the log was made; it is stored in the recording."),
    ] = "",
    robot: Annotated[str, typer.Option(help="Robot name in the keys of the recording.")] = "robot",
    frame: Annotated[
        str, typer.Option(help="Frame to which the poses in the recording refer: base_link or laser.")
    ] = "base_link",
    *,
    reading: Reading,
    rate: Annotated[
        float | None, typer.Option(min=0.01, max=1000, help="Scan rate of an .npz file without stamps, Hz.")
    ] = None,
    sigma: Annotated[
        float | None, typer.Option(min=1e-4, max=10, help="Range noise of the scanner, m. Defaults to unknown.")
    ] = None,
    json_file: Json = None,
) -> None:
    """Convert a log of another program to a recording with its scans, odometry and reference poses.

    The format is recognised from the content: CARMEN logs (.log, .clf, also .gz, .bz2, .xz), ROS 1 bags (.bag), ROS 2
    bags (a folder with metadata.yaml, .db3, .mcap) and .npz (docs/logs.md). Assumptions and omissions are reported.
    The recording works like any other with info, replay, localize, rerun, plot, export and the live page. Reference
    poses become the topic truth; they are only as accurate as those of the log.

    Examples: `presage import fr079.log.gz -o fr079.mcap --world fr079.yaml`;
    `presage import drive.bag --scan-topic /scan_front`; `presage import bag_folder --mount 0.2,0,0 --no-reference`;
    `presage import scans.npz --frame laser`; `presage import gfs.log --reference` (the poses of its scans were
    corrected by a mapping program).
    """
    from common.errors import UserError  # noqa: PLC0415
    from presage.logs.importing import ImportOptions, import_command  # noqa: PLC0415
    from presage.replay.bus_replay import checked_robot  # noqa: PLC0415

    if frame not in ("base_link", "laser"):
        raise UserError(f"no frame {frame!r}: choose base_link or laser")
    stem = file.resolve().name.split(".")[0]
    target = out or Path(f"{stem}.mcap")
    job = ImportOptions(file, target, reading, world, checked_robot(robot), frame == "laser", rate, sigma)
    import_command(job, json_file, console, err_console)


@app.command("map", rich_help_panel="Learn", short_help="Build a ROS map from a drive with known poses.")
@reads_logs
def map_(
    log: Annotated[Path, typer.Argument(help="A recording or log with reference poses (docs/logs.md).")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Map to write, NAME.yaml. Defaults to the log's name, in this folder."),
    ] = None,
    half: Annotated[
        str, typer.Option(help="Half of the drive to use: first or second. Defaults to the whole drive.")
    ] = "",
    cell: Annotated[float, typer.Option(min=0.005, max=1.0, help="Edge length of a cell, m.")] = 0.05,
    *,
    reading: Reading,
) -> None:
    """Build a ROS map (NAME.yaml and .pgm) from a drive with known poses. This is not SLAM.

    A cell is occupied if beams of at least two scans ended in it, and of at least 60 % of the scans that observed it.
    It is free if a beam passed through it, otherwise unknown.

    Examples: `presage map run.mcap`; `presage map fr079.npz --mount 0,0,0 --half first -o first_half.yaml`, then
    `presage experiment real --log fr079.npz --mount 0,0,0 --map first_half.yaml`.
    """
    from presage.learning.map_of_log import MapOptions, map_command  # noqa: PLC0415

    target = out or Path(f"{log.resolve().name.split('.')[0]}.yaml")
    map_command(MapOptions(log, target, half, cell, reading), console, err_console)
