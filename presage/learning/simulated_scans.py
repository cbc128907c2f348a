"""Gets scans for training at chosen poses, from the running session or from a simulator that it starts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from rich.console import Console
from rich.progress import Progress

from common.bus.bus import Bus, Link, open_bus, wait_until
from common.errors import UserError
from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.requests import Request, SampleReply, SampleRequest, WorldReply
from common.messages.topics import SAMPLE, WORLD
from common.robot.scanner import Scanner
from presage.session.stack import Stack
from services.estimator.precise.learning.weights import same_walls

POSES_PER_REQUEST = 500


@contextmanager
def scanner_on_bus(
    link: Link,
    world_name: str,
    simulator_arguments: tuple[str, ...],
    world: World,
    scanner: Scanner,
    console: Console,
) -> Iterator[Bus]:
    """Opens a bus on which this scanner in this world answers the query `sample`.

    Uses the running session if it has this scanner and world, otherwise starts a simulator.
    """
    with open_bus(link, connect_timeout=3.0) as bus:
        if wait_until(bus.linked, 1.0) and _is_suitable(bus, world, scanner, console):
            yield bus
            return
    with Stack("training", quiet=True) as stack:
        stack.start_router()
        # Exact rays, which take a fraction of the time of pybullet's.
        options = ("--physics", "kinematic", "--pace", "realtime")
        stack.start("simulator", "--world", world_name, *simulator_arguments, *options)
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
            yield bus


def _is_suitable(bus: Bus, world: World, scanner: Scanner, console: Console) -> bool:
    """Whether the session has the wanted scanner and world; prints the result if there is a session."""
    try:
        session = bus.query(WORLD, Request(), WorldReply, timeout=1.0)
    except UserError:
        return False
    if session.world is not None and same_walls(session.world, world) and session.scanner is not None:
        ignored = {"beams", "rate"}  # the number of beams is part of the request, and the rate does not matter
        if session.scanner.model_dump(exclude=ignored) == scanner.model_dump(exclude=ignored):
            console.print(f"samples come from the running scanner {session.scanner.name} in {world.name}")
            return True
    console.print("the running session has another world or scanner: starting a simulator for the training")
    return False


def collect(
    bus: Bus,
    poses: Array,
    scanner: Scanner,
    seed: int | None,
    bar: Progress,
    title: str,
) -> Array:
    """Ranges (N, B) m at ``poses`` (N, 3); +inf for no return, -inf for too close.

    The scans have noise with the random seed ``seed``, or none if it is None. Raises UserError if the scanner refuses.
    """
    task = bar.add_task(title, total=len(poses))
    rows = []
    for number, start in enumerate(range(0, len(poses), POSES_PER_REQUEST)):
        block = poses[start : start + POSES_PER_REQUEST]
        request = SampleRequest(
            poses=block, beams=scanner.beams, noise=seed is not None, seed=(seed or 0) * 100_003 + number
        )
        reply = bus.query(SAMPLE, request, SampleReply, timeout=60.0)
        if not reply.ok or reply.scanner is None:
            raise UserError(f"the scanner refuses the request: {reply.reason or 'it sends no description of itself'}")
        if len(reply.ranges) != len(block) * scanner.beams:
            raise UserError(f"the scanner answered {len(reply.ranges)} ranges for {len(block)} x {scanner.beams}")
        rows.append(reply.ranges.reshape(len(block), -1).astype(np.float64))
        bar.advance(task, len(block))
    return np.concatenate(rows)
