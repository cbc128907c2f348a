"""The step sizes β and γ.

Two loops over E3's journeys, both in one process. **Displacement**: the literal algorithm 1 (`teleports.py`), where the
step sizes determine the number of iterations: the paper's 12.5 iterations mean that each one closes about a fifth of
the distance, ln(12 / 0.8) / 12.5. **Velocity**: presage's controller and the simulator's physics with preset paper,
where an iteration is a scan at 15 Hz and the robot's speed limit determines the number.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from rich.console import Console

from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import Belief, Goal, Pose
from common.robot.robot import Robot
from lab.experiments import results
from lab.experiments.estimators import ExperimentWorld
from lab.experiments.start_and_goal import ARRIVAL_DISTANCE, StartAndGoal, draw_start_and_goal, least_time
from lab.experiments.trials import run_trials
from lab.paper import e3_navigation as navigation
from lab.paper.teleports import StepSizes, travel
from presage.plotting import style as drawing
from services.controller.navigator import Navigator
from services.controller.policies.paper_action import ActionParameters
from services.controller.policies.straight_line import StraightLinePolicy
from services.estimator.paper import weights
from services.estimator.paper.decoder import PaperModel, use_one_core
from services.estimator.paper.estimator import PaperEstimator
from services.estimator.paper.perception import Descent
from services.estimator.paper.training import usable_ranges
from services.estimator.shared.interface import Observation, Posterior
from services.estimator.shared.model_folder import SHIPPED

EXPERIMENT_ID = 5  # part of the random seeds; the journeys are those of E3
PAPER_ITERATIONS = 12.5  # iterations, the paper's mean over 50 trials
ALPHA = 2e-3  # m² along x, in the network's coordinates: the largest value without oscillation of the belief
GAMMAS = (1e-3, 2e-3, 3e-3, 5e-3, 8e-3)  # m²
BETAS = (0.3, 1.0, 3.0)
SUMS = (1e-4, 3e-4, 1e-3)
VELOCITY_GAMMAS, VELOCITY_BETAS = (0.05, 0.1, 0.3, 0.8), (0.03, 0.1, 0.3)
VELOCITY_DIVISOR = 5  # one journey in five is also driven with velocities, which takes a second per ten metres


@dataclass(frozen=True)
class Setting:
    """One setting of the sweep. The velocity loop uses only beta and gamma, and gamma has no unit there."""

    loop: Literal["displacement", "velocity"]
    steps: StepSizes

    @property
    def name(self) -> str:
        """Name of the setting in tables and results."""
        steps = self.steps
        if self.loop == "velocity":
            return f"velocity, β {steps.beta:g}, γ {steps.gamma:g}"
        where = "" if steps.normalised else ", in metres"
        return f"displacement, {steps.form}{where}, β {steps.beta:g}, γ {steps.gamma:g}"


@dataclass(frozen=True)
class StepSizeJob:
    """One journey with one setting."""

    index: int
    seed: int
    limit: int = 150  # maximum number of iterations in the displacement loop
    velocity_limit: int = 900  # maximum number of iterations in the velocity loop
    field: ExperimentWorld = ExperimentWorld()  # noqa: RUF009 - frozen
    setting: Setting = Setting("displacement", StepSizes())


def settings() -> list[Setting]:
    """All settings of the sweep."""
    every = [StepSizes(ALPHA, beta, gamma) for beta in BETAS for gamma in GAMMAS]
    every += [StepSizes(ALPHA, 1.0, gamma, "sum") for gamma in SUMS]
    # With equal step sizes along both axes, alpha is limited by the short axis, along which the scan changes most.
    every += [StepSizes(5e-4, 1.0, 1e-3, normalised=False), StepSizes(ALPHA, 1.0, 1e-3, "printed")]
    driven = [StepSizes(beta=0.0, gamma=gamma) for gamma in VELOCITY_GAMMAS]
    driven += [StepSizes(beta=beta, gamma=ActionParameters().gamma) for beta in VELOCITY_BETAS]
    return [Setting("displacement", each) for each in every] + [Setting("velocity", each) for each in driven]


def trial(job: StepSizeJob) -> dict[str, Any]:
    """Runs one journey. Returns its number of iterations, and in the velocity loop its time over the minimum."""
    world = job.field.scene(0).world
    ends = draw_start_and_goal(world, np.random.default_rng((job.seed, navigation.EXPERIMENT_ID, job.index)), Robot())
    drive = _run_displacement if job.setting.loop == "displacement" else _run_velocity
    return {"setting": job.setting.name, "straight_m": ends.straight, **drive(job, world, ends)}


@functools.lru_cache(maxsize=2)
def _model(field: ExperimentWorld) -> tuple[PaperModel, weights.ModelCard]:
    use_one_core()
    return weights.load(weights.find(SHIPPED, field.world, field.beams))


def _run_displacement(job: StepSizeJob, world: World, ends: StartAndGoal) -> dict[str, Any]:
    scene = job.field.scene(job.seed, EXPERIMENT_ID, job.index)

    def look(pose: Array) -> Array:
        return usable_ranges(scene.observe(scene.clean(pose[None])[0], 0.0).ranges, scene.scanner.range_max)

    outcome = travel(ends, job.setting.steps, _model(job.field)[0], look, world, job.field.heading, job.limit)
    return {
        "reached": outcome.reached,
        "iterations": outcome.iterations,
        "stopped": outcome.stopped,
        "error_m": float(outcome.error.mean()),
        "distance_m": np.round(outcome.distance, 4).tolist(),
    }


def _run_velocity(job: StepSizeJob, world: World, ends: StartAndGoal) -> dict[str, Any]:
    """Drives as in E3, but in one process and with the job's step sizes."""
    from services.simulator.simulation import Simulation, SimulationSetup  # pybullet, for this alone

    scanner, steps = job.field.scene(0).scanner, job.setting.steps
    pose, goal = (*ends.start, job.field.heading), np.array([*ends.goal, job.field.heading])
    model, card = _model(job.field)
    perception = PaperEstimator(model, card, Descent(beta=steps.beta), np.array(pose))
    navigator = Navigator(Robot(), world, StraightLinePolicy(Robot(), ActionParameters(gamma=steps.gamma), world))
    navigator.on_goal(Goal(stamp_ns=0, pose=Pose.of(goal)))
    simulation = Simulation(SimulationSetup(world, scanner, Robot(), pose, job.seed * 100_003 + job.index))
    errors, contacts = [], 0
    try:
        while True:
            _, truth, scan = simulation.observe()
            here = truth.pose.array()
            away, contacts = float(np.hypot(*(here - goal)[:2])), contacts + truth.contact
            if away <= ARRIVAL_DISTANCE or simulation.steps >= job.velocity_limit:
                break
            observation = Observation(scan.ranges.astype(float), scan.angles(), scan.range_max, goal=goal)
            posterior = perception.update(observation)
            errors.append(float(np.hypot(*(posterior.pose - here)[:2])))
            navigator.on_scan(scan)
            simulation.command(scan.stamp_ns, navigator.step(_belief(scan.stamp_ns, posterior))[0].twist)
            simulation.advance()
    finally:
        simulation.close()
    over = simulation.stamp_ns * 1e-9 / least_time(ends.straight, Robot())
    return {
        "reached": away <= ARRIVAL_DISTANCE,
        "iterations": simulation.steps,
        "time_over_least": over,
        "contacts": contacts,
        "error_m": float(np.mean(errors)),
        "distance_m": [away],
    }


def _belief(stamp_ns: int, posterior: Posterior) -> Belief:
    return Belief(
        stamp_ns=stamp_ns,
        state=posterior.state,
        pose=Pose.of(posterior.pose),
        xi=posterior.xi.astype(np.float32),
        curvature=posterior.curvature,
        free_energy=posterior.free_energy,
        accuracy=posterior.accuracy,
    )


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Statistics of one setting; iterations and times only of journeys that reached the goal."""
    reached = [row for row in rows if row["reached"]]
    over = [row["time_over_least"] for row in reached if "time_over_least" in row]
    return {
        "journeys": len(rows),
        "reached": len(reached),
        "iterations_mean": float(np.mean([row["iterations"] for row in reached])) if reached else None,
        "time_over_least_median": float(np.median(over)) if over else None,
        "stopped_by_walls": sum(row.get("stopped", 0) for row in rows),
        "error_mean_m": float(np.mean([row["error_m"] for row in rows])),
    }


def run(job: StepSizeJob, trials: int, out: Path, workers: int, console: Console) -> results.Result:
    """Runs every setting over the first ``trials`` journeys of E3.

    Writes steps.json, .csv, .trials.jsonl, .pdf and .png into ``out``.
    """
    grid = settings()
    counts = [trials if each.loop == "displacement" else max(1, trials // VELOCITY_DIVISOR) for each in grid]
    jobs = [replace(job, index=k, setting=each) for each, count in zip(grid, counts, strict=True) for k in range(count)]
    rows = run_trials("steps", trial, jobs, out, workers, console)
    summary = {each.name: summarise([row for row in rows if row["setting"] == each.name]) for each in grid}
    curves: dict[str, list[Any]] = {
        "loop": [each.loop for each in grid],
        **{name: [getattr(each.steps, name) for each in grid] for name in ("form", "normalised", "beta", "gamma")},
        **{
            name: [summary[each.name][name] for each in grid]
            for name in ("journeys", "reached", "iterations_mean", "time_over_least_median")
        },
    }
    result = results.Result(
        "steps",
        "Step sizes of action and goal",
        job.seed,
        {**asdict(job), "trials": trials, "alpha": ALPHA},
        summary,
        curves,
        rows,
        [_note_on_nearest(grid, summary, trials)],
    )
    result.write(out, draw(grid, summary))
    return result


def _note_on_nearest(grid: Sequence[Setting], summary: dict[str, dict[str, Any]], trials: int) -> str:
    """Which setting reached every goal in the number of iterations that is nearest to the paper's."""
    nearest = min(
        (each for each in grid if each.loop == "displacement" and summary[each.name]["reached"] == trials),
        key=lambda each: abs(summary[each.name]["iterations_mean"] - PAPER_ITERATIONS),
        default=None,
    )
    if nearest is None:
        return "no setting reached every goal"
    mean = summary[nearest.name]["iterations_mean"]
    return (
        f"nearest to the paper's {PAPER_ITERATIONS:g} iterations, where every goal is reached: "
        f"{nearest.name}: {mean:.1f}"
    )


def draw(grid: Sequence[Setting], summary: dict[str, dict[str, Any]]) -> Figure:
    """Iterations over γ for each β, with the paper's 12.5 marked, and time over the minimum in the velocity loop."""
    figure, (left, right) = drawing.figure_of(2)
    moved = [each for each in grid if each.loop == "displacement" and each.steps.normalised]
    for beta, colour in zip(BETAS, ("#56B4E9", "#0072B2", "#000000"), strict=True):
        own = [each for each in moved if each.steps.form == "step" and each.steps.beta == beta]
        _line(left, own, summary, "gamma", "iterations_mean", f"β = {beta:g}", colour)
    summed = [each for each in moved if each.steps.form == "sum"]
    _line(left, summed, summary, "gamma", "iterations_mean", "β = 1, action summed (eq. 4)", "#D55E00")
    left.axhline(PAPER_ITERATIONS, linestyle="--", color=drawing.GOAL, linewidth=1.2, label="the paper's 12.5")
    left.set(
        xlabel="γ (m²)",
        ylabel="iterations until within 0.8 m, mean",
        title="displacements (hollow: not every goal reached)",
    )
    _logarithmic(left, "y", "x")
    driven = [each for each in grid if each.loop == "velocity"]
    gammas, betas = ([each for each in driven if (each.steps.beta == 0) == plain] for plain in (True, False))
    over = "time_over_least_median"
    _line(right, gammas, summary, "gamma", over, "against γ, at β = 0", "#0072B2")
    _line(right, betas, summary, "beta", over, "against β, at γ = 0.3", "#E69F00")
    right.axhline(1, linestyle="--", color=drawing.BOUND, linewidth=1)
    right.set(xlabel="γ, or β", ylabel="time over the least possible", title="velocities, through physics")
    right.set(ylim=(0.99, max(1.15, right.get_ylim()[1])))
    _logarithmic(right, "x")
    for axes in (left, right) if right.collections else (left,):
        axes.legend(frameon=False, fontsize=9)
    return figure


def _logarithmic(axes: Axes, *names: str) -> None:
    """Makes the named axes logarithmic, unless the plot is empty."""
    for name in names if axes.collections else ():
        drawing.log_metres(axes, name)
        (axes.yaxis if name == "y" else axes.xaxis).set_minor_formatter(NullFormatter())


def _line(
    axes: Axes, own: Sequence[Setting], summary: dict[str, dict[str, Any]], by: str, what: str, label: str, colour: str
) -> None:
    """Plots one line; its marks are filled where every goal was reached, and hollow where only some were."""
    rows = [(getattr(each.steps, by), summary[each.name]) for each in own if summary[each.name]["reached"]]
    if not rows:
        return
    x, y = [step for step, _ in rows], [row[what] for _, row in rows]
    axes.plot(x, y, color=colour, linewidth=1.4, label=label)
    fill = [colour if row["reached"] == row["journeys"] else "white" for _, row in rows]
    axes.scatter(x, y, color=fill, edgecolors=colour, s=30, zorder=3)


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The Markdown table of docs/experiments.md."""
    heads = ("step sizes", "reached", "iterations, mean", "error, mean (m)")
    rows = [
        [
            name,
            f"{row['reached']}/{row['journeys']}",
            results.number(row["iterations_mean"], 1),
            results.number(row["error_mean_m"]),
        ]
        for name, row in summary.items()
    ]
    return results.markdown(heads, rows)
