"""`presage bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.robot.scanner import SCANNERS
from presage.cli.security import secured
from presage.terminal.options import Json, WorldName, console

app = typer.Typer(help="Benchmarks. Each compares with a baseline or a limit in the same run.", no_args_is_help=True)


@app.command("latency")
@secured
def bench_latency(
    scans: Annotated[int, typer.Option(min=10, help="Number of scans to measure.")] = 300,
    rate: Annotated[float, typer.Option(min=1, max=1000, help="Scans per second.")] = 15.0,
    beams: Annotated[int, typer.Option(help="Beams per scan.")] = 622,
    json_file: Json = None,
) -> None:
    """Latency from scan to velocity command through the real services, compared with a plain zenoh round trip.

    Examples: `presage bench latency --json latency.json`; `presage bench latency --security keys` (TLS, roles).
    """
    from lab.benchmarks.latency import bench_latency as run  # noqa: PLC0415

    raise typer.Exit(run(scans, rate, beams, json_file, console))


@app.command("viewer")
def bench_viewer(
    seconds: Annotated[float, typer.Option(min=1.0, help="Duration of one round, s.")] = 20.0,
    rounds: Annotated[int, typer.Option(min=1, help="Number of rounds without and with the page.")] = 3,
    beams: Annotated[int, typer.Option(help="Beams per scan.")] = 622,
    json_file: Json = None,
) -> None:
    """Processor time of the live page with one browser, and the control loop's latency with and without the page.

    Example: `presage bench viewer --json viewer.json`.
    """
    from lab.benchmarks.viewer import bench_viewer as run  # noqa: PLC0415

    raise typer.Exit(run(seconds, rounds, beams, json_file, console))


@app.command("map")
def bench_map(
    world: Annotated[str, typer.Option(help="A ROS map.yaml or any world. Default: a generated map.")] = "",
    size: Annotated[int, typer.Option(min=200, max=4000, help="Cells per side of the generated map.")] = 1000,
    beams: Annotated[int, typer.Option(min=2, help="Beams per scan.")] = 622,
    out: Annotated[Path | None, typer.Option(help="Folder in which to keep the generated map.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    json_file: Json = None,
) -> None:
    """Costs of a large ROS map: loading it, sending it, casting rays in it and planning on it.

    Examples: `presage bench map`; `presage bench map --world my/map.yaml`; `presage bench map --size 2000 --out made`.
    """
    from lab.benchmarks.maps import bench_map as run  # noqa: PLC0415

    raise typer.Exit(run(world, size, beams, out, seed, json_file, console))


@app.command("metrics")
def bench_metrics(
    seconds: Annotated[float, typer.Option(min=1.0, help="Duration of one round, s.")] = 20.0,
    rounds: Annotated[int, typer.Option(min=1, help="Number of rounds without and with scrapes.")] = 3,
    json_file: Json = None,
) -> None:
    """Processor time that Prometheus metrics cost each service: rounds with one scrape per second, and without.

    Examples: `presage bench metrics`; `presage bench metrics --seconds 5 --rounds 1 --json metrics.json`.
    """
    from lab.benchmarks.metrics import bench_metrics as run  # noqa: PLC0415

    raise typer.Exit(run(seconds, rounds, json_file, console))


@app.command("localisation")
def bench_localisation(
    world: WorldName = "corridor",
    beams: Annotated[int, typer.Option(help="Beams per scan.")] = 622,
    trials: Annotated[int, typer.Option(min=1, help="Number of random places.")] = 100,
    scans: Annotated[int, typer.Option(min=1, help="Scans per trial.")] = 25,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 1,
    json_file: Json = None,
) -> None:
    """How often preset paper, starting at the map's centre, localises a standing robot.

    Example: `presage bench localisation --trials 20`.
    """
    from lab.accuracy.paper_localisation import bench_localisation as run  # noqa: PLC0415

    raise typer.Exit(run(world, beams, trials, scans, seed, json_file, console))


@app.command("accuracy")
def bench_accuracy(
    worlds: Annotated[str, typer.Option(help="Comma-separated worlds.")] = "office",
    beams: Annotated[
        str,
        typer.Option(
            help="Comma-separated numbers of beams. Default: the scanner's own; for tim571 622, as in the paper."
        ),
    ] = "",
    estimators: Annotated[
        str, typer.Option(help="Comma-separated: precise, precise-exact, particle-filter, amcl-defaults.")
    ] = "precise,precise-exact,particle-filter",
    tasks: Annotated[
        str,
        typer.Option(help="Comma-separated: standing, blocked, kidnapped, tracking, odometry, twins. Default: all."),
    ] = "",
    trials: Annotated[int, typer.Option(min=2, help="Number of places per task.")] = 100,
    minutes: Annotated[
        float, typer.Option(min=0.05, help="Duration of each tracked path, at the scanner's rate.")
    ] = 2.0,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Random seed.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes that run in parallel.")] = 2,
    json_file: Json = None,
    figure: Annotated[Path | None, typer.Option(help="File for a figure: PNG, SVG or PDF.")] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a short Markdown table, as in README.")] = False,
    scanner: Annotated[
        str, typer.Option(help=f"Comma-separated: {', '.join(SCANNERS)}, or scanner files (docs/scanners.md).")
    ] = "tim571",
) -> None:
    """Accuracy of the estimators compared with the Cramér-Rao bound.

    The tasks: global localisation of a standing robot, also with blocked beams; kidnapping; tracking with and without
    odometry; and two identical rooms.

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
    beams: Annotated[str, typer.Option(help="Comma-separated numbers of beams.")] = "622,811",
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Random seed.")] = 1,
    json_file: Json = None,
) -> None:
    """Update time and memory of every estimator on one core, each in its own process.

    Example: `presage bench speed --beams 622 --json speed.json`.
    """
    from lab.accuracy.speed import bench_speed as run  # noqa: PLC0415

    raise typer.Exit(run(world, beams, seed, json_file, console))


@app.command("decoders")
def bench_decoders(
    world: WorldName = "office",
    samples: Annotated[int, typer.Option(min=100, help="Number of training scans.")] = 5000,
    steps: Annotated[int, typer.Option(min=1, help="Training steps of each network, 256 scans each.")] = 3000,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Random seed.")] = 0,
    json_file: Json = None,
) -> None:
    """Error, size and training time of alternative generative models, all trained on the same scans.

    Example: `presage bench decoders --steps 300 --json decoders.json`.
    """
    from lab.accuracy.decoders import bench_decoders as run  # noqa: PLC0415

    raise typer.Exit(run(world, samples, steps, seed, json_file, console))


@app.command("recorder")
def bench_recorder(
    rate: Annotated[
        float, typer.Option(min=1, max=100_000, help="Messages per second; a normal session has about 100.")
    ] = 2000,
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration, s.")] = 60.0,
    beams: Annotated[int, typer.Option(min=1, max=100_000, help="Beams per message; 811 are 3.4 kB.")] = 811,
    out: Annotated[
        Path | None, typer.Option(help="Folder in which to keep the recording. Default: it is deleted.")
    ] = None,
    json_file: Json = None,
) -> None:
    """A real recorder under twenty times the normal load: lost or altered messages, memory and processor time.

    Examples: `presage bench recorder`; `presage bench recorder --seconds 10 --rate 5000 --json recorder.json`.
    """
    from lab.benchmarks.recorder import Load  # noqa: PLC0415
    from lab.benchmarks.recorder import bench_recorder as run  # noqa: PLC0415

    raise typer.Exit(run(Load(rate, seconds, beams), out, json_file, console))


@app.command("chaos")
def bench_chaos(
    faults: Annotated[
        list[str] | None, typer.Argument(help="Names of faults; 'killed*' selects several. Default: all.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="How often to inject each fault.")] = 1,
    one_host: Annotated[
        bool, typer.Option("--one-host", help="Use no network namespaces; skips faults that need several hosts.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show the output of all processes.")] = False,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the table as Markdown, as in docs/faults.md.")
    ] = False,
    json_file: Json = None,
) -> None:
    """Injects faults into a running system: processes that die, freeze or start twice, bad networks, random payloads.

    A real system drives back and forth, and each fault happens at full speed. Where this machine allows network
    namespaces (Linux; as root, or with user namespaces), the robot, the estimator and the rest run on three hosts.

    Examples: `presage bench chaos`, `presage bench chaos 'killed*' --repeats 3 --json chaos.json`.
    """
    from lab.fault_injection.bench import bench_chaos as run  # noqa: PLC0415

    raise typer.Exit(
        run(faults or [], repeats, json_file, console, one_host=one_host, quiet=not verbose, in_markdown=markdown)
    )


@app.command("fleet")
def bench_fleet(
    estimators: Annotated[str, typer.Option(help="Comma-separated: precise, paper.")] = "precise,paper",
    world: WorldName = "corridor",
    beams: Annotated[int, typer.Option(min=1, help="Beams per scan.")] = 622,
    rate: Annotated[float, typer.Option(min=1, max=100, help="Scans per second of each robot.")] = 15.0,
    seconds: Annotated[
        float, typer.Option(min=1, help="Duration of the measurement for each number of robots, s.")
    ] = 6.0,
    most: Annotated[int, typer.Option(min=1, max=200, help="Largest number of robots to try.")] = 32,
    share: Annotated[
        float,
        typer.Option(
            min=0.5, max=1.0, help="Share of the scans that must be answered within a scan period to count as served."
        ),
    ] = 0.999,
    quick: Annotated[
        bool, typer.Option("--quick", help="Only estimator precise, 3 s per measurement, at most 8 robots.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Random seed.")] = 1,
    json_file: Json = None,
) -> None:
    """How many robots one core can serve in time: with one estimator process for all, or one process per robot.

    The estimators share one core. Scans are computed beforehand and sent from the other cores. Compare the two
    deployments with one another: the absolute numbers depend on the machine.

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
    seconds: Annotated[float, typer.Option(min=5.0, help="Duration of the measurement, s.")] = 30.0,
    beams: Annotated[int, typer.Option(min=2, help="Beams per scan.")] = 622,
    json_file: Json = None,
) -> None:
    """Network traffic and delays with the robot, the estimator and the rest on three hosts.

    The hosts are network namespaces on this machine (Linux; as root, or with user namespaces).

    Example: `presage bench hosts --json hosts.json`.
    """
    from lab.fault_injection.links import bench_hosts as run  # noqa: PLC0415

    raise typer.Exit(run(seconds, beams, json_file, console))
