"""`presage bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from common.robot.scanner import SCANNERS
from lab.cli.options import Trials, mount_pose, worker_count
from presage.terminal.options import Json, MountText, WorldName, console

app = typer.Typer(help="Benchmarks. Each compares with a baseline or a limit in the same run.", no_args_is_help=True)

BEAMS = 622  # as in the paper
Seconds = Annotated[float, typer.Option(min=0.1, help="Duration of one measurement, s.")]
Rounds = Annotated[int, typer.Option(min=1, help="Number of rounds, each with and without what is measured.")]
GeneratedFolder = Annotated[
    Path | None, typer.Option("--out", "-o", help="Folder in which to keep the generated files.")
]
Seed = Annotated[int, typer.Option(min=0, max=2**31, help="Random seed.")]


@app.command("latency")
def bench_latency(
    scans: Annotated[int, typer.Option(min=10, help="Number of scans to measure.")] = 300,
    json_file: Json = None,
) -> None:
    """Latency from scan to velocity command through the real services, compared with a plain zenoh round trip.

    Examples: `presage bench latency --json latency.json`; `PRESAGE_SECURITY=keys presage bench latency` (TLS, roles).
    """
    from lab.benchmarks.latency import bench_latency as run

    raise typer.Exit(run(scans, 15.0, BEAMS, json_file, console))


@app.command("viewer")
def bench_viewer(seconds: Seconds = 20.0, rounds: Rounds = 3, json_file: Json = None) -> None:
    """Processor time of the live page with one browser, and the control loop's latency with and without the page.

    Example: `presage bench viewer --json viewer.json`.
    """
    from lab.benchmarks.viewer import bench_viewer as run

    run(seconds, rounds, BEAMS, json_file, console)


@app.command("cpu")
def bench_cpu(seconds: Seconds = 60.0, json_file: Json = None) -> None:
    """Processor time and memory of each service at 15 Hz, while the robot drives and one browser shows the page.

    Example: `presage bench cpu --json cpu.json`.
    """
    from lab.benchmarks.cpu import bench_cpu as run

    run(seconds, BEAMS, json_file, console)


@app.command("map")
def bench_map(
    world: Annotated[str, typer.Option(help="A ROS map.yaml or any world. Defaults to a generated map.")] = "",
    size: Annotated[int, typer.Option(min=200, max=4000, help="Cells per side of the generated map.")] = 1000,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder in which to keep the generated map.")] = None,
    json_file: Json = None,
) -> None:
    """Costs of a large ROS map: loading it, sending it, casting rays in it and planning on it.

    Examples: `presage bench map`; `presage bench map --world my/map.yaml`; `presage bench map --size 2000 --out made`.
    """
    from lab.benchmarks.maps import bench_map as run

    run(world, size, BEAMS, out, 0, json_file, console)


@app.command("area")
def bench_area(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the learned buildings.")],
    areas: Annotated[str, typer.Option(help="Comma-separated areas in m².")] = "144,500,2000,8000",
    places: Annotated[int, typer.Option(min=1, help="Number of random places for each area.")] = 100,
    moved: Annotated[float, typer.Option(min=0, max=1, help="Share of moved furniture in a second run.")] = 0.5,
    seed: Seed = 5,
    json_file: Json = None,
) -> None:
    """Global localisation from one scan by the size of the map: generated office buildings side by side.

    Example: `presage bench area --out built --areas 144,2000 --places 20`.
    """
    from lab.benchmarks.area import bench_area as run

    run(areas, places, moved, seed, out, worker_count(), json_file, console)


@app.command("mapping")
def bench_mapping(
    log: Annotated[Path | None, typer.Option(help="A log to map, of any format in docs/logs.md.")] = None,
    relations: Annotated[
        Path | None, typer.Option(help="Its true relative poses: two times, x, y, z, roll, pitch, yaw in each line.")
    ] = None,
    worlds: Annotated[int, typer.Option(min=0, max=1000, help="Number of generated buildings.")] = 5,
    seed: Seed = 1,
    seconds: Annotated[float, typer.Option(min=1, help="Length of a simulated drive.")] = 600.0,
    json_file: Json = None,
) -> None:
    """Errors of `presage map` without reference poses, with odometry and without.

    Examples: `presage bench mapping --worlds 2 --seconds 60`;
    `presage bench mapping --worlds 0 --log fr079.clf.bz2 --relations fr079.relations --json mapping.json`.
    """
    from lab.benchmarks.mapping import bench_mapping as run

    run(log, relations, worlds, seed, seconds, json_file, console)


@app.command("mapping-faults")
def bench_mapping_faults(
    worlds: Annotated[int, typer.Option(min=1, max=1000, help="Number of generated buildings for each case.")] = 3,
    seed: Seed = 1,
    seconds: Annotated[float, typer.Option(min=10, help="Length of a drive.")] = 120.0,
    json_file: Json = None,
) -> None:
    """Errors of mapping if the robot is kidnapped, among a crowd, and in look-alike rooms.

    Examples: `presage bench mapping-faults --worlds 1 --seconds 60`;
    `presage bench mapping-faults --json mapping-faults.json`.
    """
    from lab.benchmarks.mapping_faults import bench_mapping_faults as run

    run(worlds, seed, seconds, json_file, console)


@app.command("training")
def bench_training(
    models: Annotated[
        str, typer.Option(help="Comma-separated models, such as corridor-precise. Defaults to all that are shipped.")
    ] = "",
    seeds: Annotated[int, typer.Option(min=1, help="Number of trainings of each model, with seeds from 1 on.")] = 5,
    samples: Annotated[
        int | None, typer.Option(min=10, help="Training scans. Defaults to those of the shipped model.")
    ] = None,
    out: GeneratedFolder = None,
    json_file: Json = None,
) -> None:
    """Errors of the shipped models, and of the same models trained with other seeds.

    Each is trained and tested by `presage train`. After Ctrl-C the same command continues.

    Examples: `presage bench training --models maze-precise --seeds 2`; `presage bench training --json training.json`.
    """
    from lab.benchmarks.training import bench_training as run

    run(models, seeds, samples, out or Path("training"), json_file, console)


@app.command("refinement")
def bench_refinement(
    worlds: Annotated[int, typer.Option(min=0, max=1000, help="Number of generated buildings beside office.")] = 2,
    seed: Seed = 1,
    seconds: Annotated[float, typer.Option(min=10, help="Length of the drive that refines.")] = 300.0,
    out: GeneratedFolder = None,
    json_file: Json = None,
) -> None:
    """Errors of localisation in a rough map, and in what `presage map --refine` makes of it with one drive.

    The rough maps are noisy grids of 5 cm cells and floor plans without furniture. Another drive is localised.

    Examples: `presage bench refinement --worlds 0 --seconds 60`; `presage bench refinement --json refinement.json`.
    """
    from lab.benchmarks.refinement import bench_refinement as run

    run(worlds, seed, seconds, out or Path("refinement"), json_file, worker_count(), console)


@app.command("visits")
def bench_visits(
    worlds: Annotated[int, typer.Option(min=0, max=1000, help="Number of generated buildings beside office.")] = 2,
    visits: Annotated[int, typer.Option(min=2, max=100, help="Number of visits.")] = 10,
    seed: Seed = 1,
    scans: Annotated[int, typer.Option(min=1, help="Number of single scans localised at each visit.")] = 60,
    out: GeneratedFolder = None,
    json_file: Json = None,
) -> None:
    """Errors of localisation in a building that changes, with a map updated by a drive at every visit.

    Before each visit, all furniture of half of the rooms is moved, and doors of these rooms are opened and closed.
    Single scans are localised in the first map, in the map before and after the update by the visit's drive, and in a
    model learned at true poses in the present world.

    Examples: `presage bench visits --worlds 0 --visits 3`; `presage bench visits --json visits.json`.
    """
    from lab.benchmarks.visits import bench_visits as run

    run(worlds, visits, seed, scans, out or Path("visits"), json_file, worker_count(), console)


@app.command("metrics")
def bench_metrics(seconds: Seconds = 20.0, rounds: Rounds = 3, json_file: Json = None) -> None:
    """Processor time that Prometheus metrics cost each service: rounds with one scrape per second, and without.

    Examples: `presage bench metrics`; `presage bench metrics --seconds 5 --rounds 1 --json metrics.json`.
    """
    from lab.benchmarks.metrics import bench_metrics as run

    run(seconds, rounds, json_file, console)


@app.command("localisation")
def bench_localisation(
    world: WorldName = "corridor",
    trials: Trials = 100,
    json_file: Json = None,
) -> None:
    """How often preset paper, starting at the map's centre, localises a standing robot within 25 scans.

    Example: `presage bench localisation --trials 20`.
    """
    from lab.accuracy.paper_localisation import bench_localisation as run

    run(world, BEAMS, trials, 25, 1, json_file, console)


@app.command("accuracy")
def bench_accuracy(
    worlds: Annotated[str, typer.Option(help="Comma-separated worlds.")] = "office",
    estimators: Annotated[
        str, typer.Option(help="Comma-separated names of docs/results.md, or all.")
    ] = "precise,precise-exact,particle-filter",
    tasks: Annotated[
        str,
        typer.Option(
            help="Comma-separated: standing, blocked, furnished, kidnapped, tracking, odometry, twins. Defaults to all."
        ),
    ] = "",
    scanner: Annotated[
        str, typer.Option(help=f"Comma-separated: {', '.join(SCANNERS)}, or scanner files (docs/scanners.md).")
    ] = "tim571",
    trials: Annotated[int, typer.Option(min=1, help="Number of trials with each seed.")] = 100,
    minutes: Annotated[
        float, typer.Option(min=0.05, help="Duration of the tracked path of each seed, at the scanner's rate.")
    ] = 2.0,
    seed: Seed = 1,
    seeds: Annotated[
        int, typer.Option(min=1, help="Number of seeds, from --seed on; each row covers all of them.")
    ] = 1,
    json_file: Json = None,
    figure: Annotated[Path | None, typer.Option(help="File for a figure: PNG, SVG or PDF.")] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a short Markdown table, as in README.")] = False,
) -> None:
    """Accuracy of the estimators compared with the Cramér-Rao bound.

    The tasks: global localisation of a standing robot, also with blocked beams and among unknown furniture; kidnapping;
    tracking with and without odometry; and two identical rooms. Scanner tim571 has 622 beams here, as in the paper.

    Examples: `presage bench accuracy --trials 20 --minutes 0.5`;
    `presage bench accuracy --estimators all --seeds 5 --trials 20 --minutes 0.5 --markdown`;
    `presage bench accuracy --tasks standing --trials 1000 --estimators precise`;
    `presage bench accuracy --worlds office,corridor,maze --json accuracy.json --figure accuracy.png`;
    `presage bench accuracy --scanner lms200,rplidar-a1 --tasks standing,tracking --markdown`.
    """
    from lab.accuracy.report import bench_accuracy as run

    run(
        worlds,
        estimators,
        tasks,
        trials,
        minutes,
        seed,
        seeds,
        worker_count(),
        json_file,
        figure,
        console,
        markdown=markdown,
        scanner=scanner,
    )


@app.command("distortion")
def bench_distortion(
    worlds: Annotated[str, typer.Option(help="Comma-separated worlds.")] = "office,maze",
    estimators: Annotated[
        str, typer.Option(help="Comma-separated, as of `bench accuracy`.")
    ] = "precise,particle-filter",
    drives: Annotated[int, typer.Option(min=1, help="Drives of each estimator in each world.")] = 5,
    seconds: Seconds = 40.0,
    seed: Seed = 1,
    json_file: Json = None,
) -> None:
    """Errors at 1 m/s and 1 rad/s if beams are measured one after another, relative to instantaneous scans.

    Example: `presage bench distortion --worlds office --drives 2 --json distortion.json`.
    """
    from lab.accuracy.motion_distortion import bench_distortion as run

    raise typer.Exit(run(worlds, estimators, drives, seconds, BEAMS, seed, json_file, console))


@app.command("integrity")
def bench_integrity(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results and the learned models.")],
    worlds: Annotated[int, typer.Option(min=0, max=1000, help="Number of generated buildings.")] = 20,
    seed: Annotated[int, typer.Option(min=0, max=2**20, help="Each seed has its own buildings.")] = 1,
    cases: Annotated[str, typer.Option(help="Comma-separated cases of docs/integrity.md. Defaults to all.")] = "",
    estimators: Annotated[
        str, typer.Option(help="Comma-separated: precise, particle-filter, particle-filter-recovery, amcl-defaults.")
    ] = "precise,particle-filter",
    model: Annotated[
        str, typer.Option(help="Model of precise: learned (30 s for each map), or exact for a quick run.")
    ] = "learned",
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Length of a drive. Defaults to 120 s for moved-*, 60 s otherwise.")
    ] = None,
    logs: Annotated[
        str,
        typer.Option(help="Comma-separated logs with reference poses: each half is localised in a map of the other."),
    ] = "",
    mount: MountText = "",
) -> None:
    """How often estimators report a wrong pose as right, in generated buildings that differ from their maps.

    Each trial is one case in one building. After Ctrl-C the same command continues, unless the code has changed. Prints
    a table for each estimator, and writes integrity.md, .json, .trials.jsonl and a reliability diagram.

    Examples: `presage bench integrity --out results`;
    `presage bench integrity --worlds 5 --cases moved-50,wrong-map --model exact --estimators precise --out quick`;
    `presage bench integrity --logs uwb.npz,fr079.npz --mount 0,0,0 --out results`.
    """
    from lab.integrity.cases import CASES
    from lab.integrity.logs import cases_of
    from lab.integrity.report import bench_integrity as run
    from lab.integrity.runner import IntegrityPlan

    names = tuple(cases.split(",")) if cases else tuple(CASES)
    laser_pose = mount_pose(mount)
    of_logs = [case for log in logs.split(",") if log for case in cases_of(log, laser_pose)]
    plan = IntegrityPlan(worlds, seed, names, tuple(estimators.split(",")), model, seconds, tuple(of_logs))
    run(plan, out, worker_count(), console)


@app.command("speed")
def bench_speed(world: WorldName = "office", json_file: Json = None) -> None:
    """Update time and memory of each estimator on one core, each in its own process, with 622 and 811 beams.

    Example: `presage bench speed --json speed.json`.
    """
    from lab.accuracy.speed import bench_speed as run

    run(world, "622,811", 1, json_file, console)


@app.command("decoders")
def bench_decoders(
    world: WorldName = "office",
    steps: Annotated[int, typer.Option(min=1, help="Training steps of each network, 256 scans each.")] = 3000,
    json_file: Json = None,
) -> None:
    """Error, size and training time of alternative generative models, all trained on the same 5000 scans.

    Example: `presage bench decoders --steps 300 --json decoders.json`.
    """
    from lab.accuracy.decoders import bench_decoders as run

    run(world, 5000, steps, 0, json_file, console)


@app.command("recorder")
def bench_recorder(
    rate: Annotated[
        float,
        typer.Option(min=1, max=100_000, help="Messages per second; a normal session has about 100."),
    ] = 2000,
    seconds: Seconds = 60.0,
    out: GeneratedFolder = None,
    json_file: Json = None,
) -> None:
    """A real recorder under twenty times the normal load: lost or altered messages, memory and processor time.

    Examples: `presage bench recorder`; `presage bench recorder --seconds 10 --rate 5000 --json recorder.json`.
    """
    from lab.benchmarks.recorder import RecorderLoad
    from lab.benchmarks.recorder import bench_recorder as run

    raise typer.Exit(run(RecorderLoad(rate, seconds), out, json_file, console))


@app.command("chaos")
def bench_chaos(
    faults: Annotated[
        list[str] | None, typer.Argument(help="Names of faults; 'killed*' selects several. Defaults to all.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="How often to inject each fault.")] = 1,
    one_host: Annotated[
        bool, typer.Option("--one-host", help="Use no network namespaces; skips faults that need several hosts.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show the output of all processes.")] = False,
    json_file: Json = None,
) -> None:
    """Fault injection into a running system: processes that die, freeze or start twice, bad networks, random payloads.

    A real system drives back and forth, and each fault happens at full speed. Where this machine allows network
    namespaces (Linux; as root, or with user namespaces), the robot, the estimator and the rest run on three hosts.

    Examples: `presage bench chaos`; `presage bench chaos 'killed*' --repeats 3 --json chaos.json`.
    """
    from lab.fault_injection.bench import bench_chaos as run

    raise typer.Exit(run(faults or [], repeats, json_file, console, one_host=one_host, quiet=not verbose))


@app.command("fleet")
def bench_fleet(
    estimators: Annotated[str, typer.Option(help="Comma-separated: precise, paper.")] = "precise,paper",
    seconds: Seconds = 6.0,
    most: Annotated[int, typer.Option(min=1, max=200, help="Largest number of robots to try.")] = 32,
    json_file: Json = None,
) -> None:
    """How many robots one core can serve in time: with one estimator process for all, or one process per robot.

    The estimators share one core. Scans are computed beforehand and sent from the other cores. A number of robots
    counts as served if 99.9 % of the scans are answered within a scan period. Compare the two deployments with one
    another: the absolute numbers depend on the machine.

    Examples: `presage bench fleet`; `presage bench fleet --estimators precise --seconds 3 --most 8` (quick).
    """
    from lab.benchmarks.fleet import FleetPlan
    from lab.benchmarks.fleet import bench_fleet as run

    plan = FleetPlan("corridor", BEAMS, rate=15.0, seconds=seconds, max_robots=most, share=0.999, seed=1)
    run(estimators, plan, json_file, console)


@app.command("hosts")
def bench_hosts(seconds: Seconds = 30.0, json_file: Json = None) -> None:
    """Network traffic and delays with the robot, the estimator and the rest on three hosts.

    The hosts are network namespaces on this machine (Linux; as root, or with user namespaces).

    Example: `presage bench hosts --json hosts.json`.
    """
    from lab.fault_injection.links import bench_hosts as run

    run(seconds, BEAMS, json_file, console)
