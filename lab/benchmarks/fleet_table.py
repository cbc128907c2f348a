"""The table of `bench fleet`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from lab.benchmarks.fleet import Plan

WAYS = ("one process", "one each")
MANY = 1000  # robots, on paper
FULL = 0.7  # of a core, that one would load it with
QUIET = 0.05  # of the core, that others may use


def _for_many(row: dict[str, Any], rate: float) -> str:
    """Cores and MB/s, from processor time and message sizes."""
    size = row["message_bytes"]
    cores = MANY * rate * row["cpu_ms_per_scan"] / 1e3
    flows = ", ".join(
        f"{name} {MANY * (rate if name != 'health' else 1.0) * size[name] / 1e6:.1f}" for name in sorted(size)
    )
    return (
        f"{row['estimator']}: {MANY} robots would take {cores:.0f} cores, {cores / FULL:.0f} at {100 * FULL:g} % load; "
        f"MB/s: {flows}"
    )


def show(rows: list[dict[str, Any]], plan: Plan, console: Console) -> dict[str, dict[str, float | None]]:
    """The table and what follows from it; by estimator the robots of one process to those of one each."""
    table = Table(
        title=f"{plan.world}, {plan.beams} beams at {plan.rate:g} Hz, one core, "
        f"{100 * plan.share:g} % of the scans answered within {1e3 / plan.rate:.1f} ms",
        title_justify="left",
    )
    for column in (
        "estimator",
        "way",
        "robots",
        "p50 ms",
        "p99 ms",
        "CPU ms a scan",
        "robots by CPU",
        "MB a robot",
        "MB in all",
    ):
        table.add_column(column, justify="left" if column in {"estimator", "way"} else "right")
    for row in rows:
        table.add_row(
            row["estimator"], row["way"], f"{row['robots_served']}",
            *(f"{row[name]:.1f}" if row[name] is not None else "" for name in ("p50_ms", "p99_ms")),
            f"{row['cpu_ms_per_scan']:.2f}",
            f"{row['robots_by_cpu']:.1f}",
            f"{row['memory_per_robot_mb']:.1f}", f"{row['memory_mb']:.0f}",
        )  # fmt: skip
    console.print(table)
    for row in rows:
        if (other := row["while_one_searches"]) is not None and other["p99_ms"] is not None:
            console.print(
                f"{row['estimator']}, {row['way']}: of {other['robots']} robots one searches each second; the others: "
                f"{100 * other['in_time_share']:.1f} % in time, "
                f"p50 {other['p50_ms']:.1f}, p99 {other['p99_ms']:.1f} ms",
                highlight=False,
            )
    size = rows[0]["message_bytes"]
    console.print(
        "bytes a message: "
        + ", ".join(f"{name} {count}" for name, count in size.items())
        + f"; scans to the estimator: {size['scan'] * plan.rate / 1e3:.1f} kB/s a robot",
        highlight=False,
    )
    for row in rows:
        if row["way"] == WAYS[0]:
            console.print(_for_many(row, plan.rate), highlight=False)
    others = max(window["others_share"] for row in rows for window in row["windows"])
    if others > QUIET:
        console.print(
            f"[bold]Other processes used up to {100 * others:.0f} % of that core meanwhile[/]: of a shared core "
            f"one process gets a smaller part than several do. Compare processor time, or run it on a quiet machine",
            highlight=False,
        )
    ratios: dict[str, dict[str, float | None]] = {}
    for name in dict.fromkeys(row["estimator"] for row in rows):
        one, each = (next(r for r in rows if r["estimator"] == name and r["way"] == way) for way in WAYS)
        ratios[name] = {
            "robots_served": one["robots_served"] / each["robots_served"] if each["robots_served"] else None,
            "robots_by_cpu": one["robots_by_cpu"] / each["robots_by_cpu"],
            "memory_per_robot": each["memory_per_robot_mb"] / max(one["memory_per_robot_mb"], 0.1),
        }
        served = f"{ratios[name]['robots_served']:.2f}" if each["robots_served"] else "no number of"
        console.print(
            f"{name}: one process serves {served} times the robots of one each; "
            f"by processor time {ratios[name]['robots_by_cpu']:.2f} times",
            highlight=False,
        )
    return ratios
