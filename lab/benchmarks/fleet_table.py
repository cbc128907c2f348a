"""The table of `bench fleet`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from lab.benchmarks.fleet import FleetPlan

ONE_PROCESS = "one process"
DEPLOYMENTS = (ONE_PROCESS, "one each")
LARGE_FLEET = 1000  # robots, for the extrapolation
CORE_LOAD = 0.7  # share of a core that one would plan to use
MAX_OTHER_LOAD = 0.05  # share of the core that other processes may use without a warning


def _large_fleet_note(row: dict[str, Any], rate: float) -> str:
    """Cores and MB/s for a large fleet, extrapolated from processor time and message sizes."""
    size = row["message_bytes"]
    cores = LARGE_FLEET * rate * row["cpu_ms_per_scan"] / 1e3
    flows = ", ".join(
        f"{name} {LARGE_FLEET * (rate if name != 'health' else 1.0) * size[name] / 1e6:.1f}" for name in sorted(size)
    )
    return (
        f"{row['estimator']}: {LARGE_FLEET} robots would take {cores:.0f} cores, "
        f"{cores / CORE_LOAD:.0f} at {100 * CORE_LOAD:g} % load; MB/s: {flows}"
    )


def show(rows: list[dict[str, Any]], plan: FleetPlan, console: Console) -> dict[str, dict[str, float | None]]:
    """Prints the table. Returns, by estimator, the ratios of one process for all robots to one process per robot."""
    console.print(_table(rows, plan))
    _print_searches(rows, console)
    size = rows[0]["message_bytes"]
    console.print(
        "bytes per message: "
        + ", ".join(f"{name} {count}" for name, count in size.items())
        + f"; scans to the estimator: {size['scan'] * plan.rate / 1e3:.1f} kB/s per robot",
        highlight=False,
    )
    for row in rows:
        if row["deployment"] == ONE_PROCESS:
            console.print(_large_fleet_note(row, plan.rate), highlight=False)
    _warn_of_other_load(rows, console)
    return {name: _compare_deployments(name, rows, console) for name in dict.fromkeys(row["estimator"] for row in rows)}


def _table(rows: list[dict[str, Any]], plan: FleetPlan) -> Table:
    table = Table(
        title=f"{plan.world}, {plan.beams} beams at {plan.rate:g} Hz, one core, "
        f"{100 * plan.share:g} % of the scans answered within {1e3 / plan.rate:.1f} ms",
        title_justify="left",
    )
    for column in (
        "estimator",
        "deployment",
        "robots",
        "p50 ms",
        "p99 ms",
        "CPU ms/scan",
        "robots by CPU",
        "MB/robot",
        "MB total",
    ):
        table.add_column(column, justify="left" if column in {"estimator", "deployment"} else "right")
    for row in rows:
        table.add_row(
            row["estimator"],
            row["deployment"],
            f"{row['robots_served']}",
            *(f"{row[name]:.1f}" if row[name] is not None else "" for name in ("p50_ms", "p99_ms")),
            f"{row['cpu_ms_per_scan']:.2f}",
            f"{row['robots_by_cpu']:.1f}",
            f"{row['memory_per_robot_mb']:.1f}",
            f"{row['memory_mb']:.0f}",
        )
    return table


def _print_searches(rows: list[dict[str, Any]], console: Console) -> None:
    """Prints how one robot's global searches delay the others."""
    for row in rows:
        if (other := row["while_one_searches"]) is not None and other["p99_ms"] is not None:
            console.print(
                f"{row['estimator']}, {row['deployment']}: {other['robots']} robots, one starts a search each second; "
                f"the others: {100 * other['in_time_share']:.1f} % in time, "
                f"p50 {other['p50_ms']:.1f}, p99 {other['p99_ms']:.1f} ms",
                highlight=False,
            )


def _warn_of_other_load(rows: list[dict[str, Any]], console: Console) -> None:
    """Prints a warning if other processes used the core too."""
    others = max(window["others_share"] for row in rows for window in row["windows"])
    if others > MAX_OTHER_LOAD:
        console.print(
            f"[bold]Other processes used up to {100 * others:.0f} % of that core[/], and one process gets a smaller "
            f"share of a busy core than several processes do. Compare processor times, or repeat on an idle machine",
            highlight=False,
        )


def _compare_deployments(estimator: str, rows: list[dict[str, Any]], console: Console) -> dict[str, float | None]:
    """Prints and returns the ratios of one process for all robots to one process per robot."""
    one, each = (
        next(r for r in rows if r["estimator"] == estimator and r["deployment"] == deployment)
        for deployment in DEPLOYMENTS
    )
    ratios = {
        "robots_served": one["robots_served"] / each["robots_served"] if each["robots_served"] else None,
        "robots_by_cpu": one["robots_by_cpu"] / each["robots_by_cpu"],
        "memory_per_robot": each["memory_per_robot_mb"] / max(one["memory_per_robot_mb"], 0.1),
    }
    served = f"{ratios['robots_served']:.2f}" if each["robots_served"] else "an unknown number of"
    console.print(
        f"{estimator}: one process for all serves {served} times as many robots as one process per robot; "
        f"extrapolated from processor time, {ratios['robots_by_cpu']:.2f} times",
        highlight=False,
    )
    return ratios
