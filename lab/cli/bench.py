"""`presage bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.robot.scanner import SCANNERS
from presage.cli.security import secured
from presage.terminal.options import Json, WorldName, console

app = typer.Typer(help="Measure, with a peer or a limit in the same run.", no_args_is_help=True)


@app.command("latency")
@secured
def bench_latency(
    scans: Annotated[int, typer.Option(min=10)] = 300,
    rate: Annotated[float, typer.Option(min=1, max=1000, help="Scans a second.")] = 15.0,
    beams: Annotated[int, typer.Option(help="Beams of a scan.")] = 622,
    json_file: Json = None,
) -> None:
    """From scan to command through the real services, beside zenoh's own round trip of the same bytes.

    Examples: `presage bench latency --json latency.json`; `presage bench latency --security keys` (TLS, roles).
    """
    from lab.benchmarks.latency import bench_latency as run  # noqa: PLC0415

    raise typer.Exit(run(scans, rate, beams, json_file, console))


@app.command("viewer")
def bench_viewer(
    seconds: Annotated[float, typer.Option(min=1.0, help="Of one round.")] = 20.0,
    rounds: Annotated[int, typer.Option(min=1, help="Without and with, so often.")] = 3,
    beams: Annotated[int, typer.Option(help="Beams of a scan.")] = 622,
    json_file: Json = None,
) -> None:
    """The live page's processor time with one visitor, and the loop's latency with and without it.

    Example: `presage bench viewer --json viewer.json`.
    """
    from lab.benchmarks.viewer import bench_viewer as run  # noqa: PLC0415

    raise typer.Exit(run(seconds, rounds, beams, json_file, console))


@app.command("map")
def bench_map(
    world: Annotated[str, typer.Option(help="A map.yaml of yours, or any world; none: one that is made.")] = "",
    size: Annotated[int, typer.Option(min=200, max=4000, help="Cells along each side of the one that is made.")] = 1000,
    beams: Annotated[int, typer.Option(min=2, help="Beams of a scan.")] = 622,
    out: Annotated[Path | None, typer.Option(help="Keep the map that is made in this folder.")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    json_file: Json = None,
) -> None:
    """What a ROS map of many cells takes: to load, to send, to scan in, to plan on.

    Examples: `presage bench map`; `presage bench map --world my/map.yaml`; `presage bench map --size 2000 --out made`.
    """
    from lab.benchmarks.maps import bench_map as run  # noqa: PLC0415

    raise typer.Exit(run(world, size, beams, out, seed, json_file, console))


@app.command("metrics")
def bench_metrics(
    seconds: Annotated[float, typer.Option(min=1.0, help="Of one round.")] = 20.0,
    rounds: Annotated[int, typer.Option(min=1, help="Without and with scrapes, so often.")] = 3,
    json_file: Json = None,
) -> None:
    """What Prometheus costs each service: scraped once a second or not at all, in turn, in one session.

    Examples: `presage bench metrics`; `presage bench metrics --seconds 5 --rounds 1 --json metrics.json`.
    """
    from lab.benchmarks.metrics import bench_metrics as run  # noqa: PLC0415

    raise typer.Exit(run(seconds, rounds, json_file, console))


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
    from lab.accuracy.paper_localisation import bench_localisation as run  # noqa: PLC0415

    raise typer.Exit(run(world, beams, trials, scans, seed, json_file, console))


@app.command("accuracy")
def bench_accuracy(
    worlds: Annotated[str, typer.Option(help="Comma-separated.")] = "office",
    beams: Annotated[
        str, typer.Option(help="Comma-separated; none: the scanner's own, of tim571 the paper's 622.")
    ] = "",
    estimators: Annotated[
        str, typer.Option(help="Of precise, precise-exact, particle-filter, amcl-defaults.")
    ] = "precise,precise-exact,particle-filter",
    tasks: Annotated[
        str, typer.Option(help="Of standing, blocked, kidnapped, tracking, odometry, twins; empty: all.")
    ] = "",
    trials: Annotated[int, typer.Option(min=2, help="Places of each task.")] = 100,
    minutes: Annotated[
        float, typer.Option(min=0.05, help="Of each path that is tracked, at the scanner's rate.")
    ] = 2.0,
    seed: Annotated[int, typer.Option(min=0, max=2**31)] = 1,
    workers: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = 2,
    json_file: Json = None,
    figure: Annotated[Path | None, typer.Option(help="PNG, SVG or PDF.")] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="A short table as in README.")] = False,
    scanner: Annotated[
        str, typer.Option(help=f"Of {', '.join(SCANNERS)}, or files (docs/scanners.md); comma-separated.")
    ] = "tim571",
) -> None:
    """Estimators and the Cramér-Rao bound side by side: from nothing, tracking, kidnapped, blocked, two rooms alike.

    Examples: `presage bench accuracy --trials 20 --minutes 0.5`;
    `presage bench accuracy --tasks standing --trials 1000 --estimators precise`;
    `presage bench accuracy --worlds office,corridor,maze --beams 622,811 --json accuracy.json --figure accuracy.png`;
    `presage bench accuracy --scanner lms200,rplidar-a1 --tasks standing,tracking --markdown`.
    """
    from lab.accuracy.report import bench_accuracy as run  # noqa: PLC0415

    code = run(
        worlds, beams, estimators, tasks, trials, minutes, seed, workers, json_file, figure,
        console, markdown=markdown, scanner=scanner,
    )  # fmt: skip
    raise typer.Exit(code)


@app.command("speed")
def bench_speed(
    world: WorldName = "office",
    beams: Annotated[str, typer.Option(help="Comma-separated.")] = "622,811",
    seed: Annotated[int, typer.Option(min=0, max=2**31)] = 1,
    json_file: Json = None,
) -> None:
    """Milliseconds an update and memory of every estimator, one core, one process each.

    Example: `presage bench speed --beams 622 --json speed.json`.
    """
    from lab.accuracy.speed import bench_speed as run  # noqa: PLC0415

    raise typer.Exit(run(world, beams, seed, json_file, console))


@app.command("decoders")
def bench_decoders(
    world: WorldName = "office",
    samples: Annotated[int, typer.Option(min=100, help="Scans to learn from.")] = 5000,
    steps: Annotated[int, typer.Option(min=1, help="Of each network's training, 256 scans each.")] = 3000,
    seed: Annotated[int, typer.Option(min=0, max=2**31)] = 0,
    json_file: Json = None,
) -> None:
    """Generative models that were tried, learned from the same scans: error, size, training time.

    Example: `presage bench decoders --steps 300 --json decoders.json`.
    """
    from lab.accuracy.decoders import bench_decoders as run  # noqa: PLC0415

    raise typer.Exit(run(world, samples, steps, seed, json_file, console))


@app.command("recorder")
def bench_recorder(
    rate: Annotated[float, typer.Option(min=1, max=100_000, help="Messages a second; a session has about 100.")] = 2000,
    seconds: Annotated[float, typer.Option(min=0.1, help="How long.")] = 60.0,
    beams: Annotated[int, typer.Option(min=1, max=100_000, help="Of each message; 811 are 3.4 kB.")] = 811,
    out: Annotated[Path | None, typer.Option(help="Folder that keeps the recording; none: it is removed.")] = None,
    json_file: Json = None,
) -> None:
    """Twenty times the normal load into a real recorder: nothing lost, every byte as sent, memory and processor.

    Examples: `presage bench recorder`; `presage bench recorder --seconds 10 --rate 5000 --json recorder.json`.
    """
    from lab.benchmarks.recorder import Load  # noqa: PLC0415
    from lab.benchmarks.recorder import bench_recorder as run  # noqa: PLC0415

    raise typer.Exit(run(Load(rate, seconds, beams), out, json_file, console))


@app.command("chaos")
def bench_chaos(
    faults: Annotated[list[str] | None, typer.Argument(help="Names of faults, such as 'killed*'; none: all.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Of each fault.")] = 1,
    one_host: Annotated[bool, typer.Option("--one-host", help="No network namespaces: fewer faults.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="With the lines of all processes.")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="The table as docs/faults.md has it.")] = False,
    json_file: Json = None,
) -> None:
    """What happens when a part dies, freezes, is cut off, is doubled, or when somebody sends noise.

    A real system drives to and fro; each fault comes at full speed. Robot, estimator and the rest are on three hosts
    of their own where this machine allows network namespaces (Linux; as root, or with user namespaces).

    Examples: `presage bench chaos`, `presage bench chaos 'killed*' --repeats 3 --json chaos.json`.
    """
    from lab.fault_injection.bench import bench_chaos as run  # noqa: PLC0415

    raise typer.Exit(
        run(faults or [], repeats, json_file, console, one_host=one_host, quiet=not verbose, in_markdown=markdown)
    )


@app.command("fleet")
def bench_fleet(
    estimators: Annotated[str, typer.Option(help="Of precise, paper; comma-separated.")] = "precise,paper",
    world: WorldName = "corridor",
    beams: Annotated[int, typer.Option(min=1, help="Of a scan.")] = 622,
    rate: Annotated[float, typer.Option(min=1, max=100, help="Scans a second of each robot.")] = 15.0,
    seconds: Annotated[float, typer.Option(min=1, help="That each number of robots is tried.")] = 6.0,
    most: Annotated[int, typer.Option(min=1, max=200, help="Robots that are tried at most.")] = 32,
    share: Annotated[
        float, typer.Option(min=0.5, max=1.0, help="Of the scans, to be answered within a period: counts as served.")
    ] = 0.999,
    quick: Annotated[bool, typer.Option("--quick", help="Precise alone, 3 s each, 8 robots at most.")] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**31)] = 1,
    json_file: Json = None,
) -> None:
    """How many robots one core serves with every scan answered in time: one estimator process, and one process each.

    The estimators share one core; scans are cast beforehand and played from the other cores. Both ways run in turn on
    the same machine: compare them with one another, for the numbers themselves are this machine's.

    Examples: `presage bench fleet`; `presage bench fleet --quick`;
    `presage bench fleet --estimators precise --most 64 --json fleet.json`.
    """
    from lab.benchmarks.fleet import Plan  # noqa: PLC0415
    from lab.benchmarks.fleet import bench_fleet as run  # noqa: PLC0415

    plan = Plan(world, beams, rate, seconds, most, share, seed)
    if quick:
        estimators, plan = "precise", Plan(world, beams, rate, 3.0, min(most, 8), share, seed)
    raise typer.Exit(run(estimators, plan, json_file, console))


@app.command("hosts")
def bench_hosts(
    seconds: Annotated[float, typer.Option(min=5.0, help="That are measured.")] = 30.0,
    beams: Annotated[int, typer.Option(min=2, help="Beams of a scan.")] = 622,
    json_file: Json = None,
) -> None:
    """What the links between robot, estimator and the rest carry, and how late things come, on three hosts.

    The hosts are network namespaces on this machine (Linux; as root, or with user namespaces).

    Example: `presage bench hosts --json hosts.json`.
    """
    from lab.fault_injection.links import bench_hosts as run  # noqa: PLC0415

    raise typer.Exit(run(seconds, beams, json_file, console))
