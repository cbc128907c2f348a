"""A slow or lossy link.

Two network devices of its own, and every frame of one goes to the other: s later, or never. Frames may overtake one
another, as with netem.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import random
import select
import struct
import sys
import time

TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000  # linux/if_tun.h
LARGEST = 65_536  # bytes of a frame


def device(name: str) -> int:
    """File descriptor of a new network device."""
    file = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(file, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TAP | IFF_NO_PI))
    return file


def relay(near: int, far: int, delay: float, jitter: float, loss: float) -> None:
    """Until killed."""
    chance, other = random.Random(0), {near: far, far: near}
    waiting: list[tuple[float, int, int, bytes]] = []
    number = 0
    while True:
        now = time.monotonic()
        while waiting and waiting[0][0] <= now:
            _, _, target, frame = heapq.heappop(waiting)
            try:
                os.write(target, frame)
            except OSError:  # not up yet, or full: lost, as on a wire
                continue
        until = waiting[0][0] - now if waiting else None
        for source in select.select([near, far], [], [], until)[0]:
            frame = os.read(source, LARGEST)
            if chance.random() < loss:
                continue
            number += 1
            due = time.monotonic() + max(0.0, delay + chance.uniform(-jitter, jitter))
            heapq.heappush(waiting, (due, number, other[source], frame))


if __name__ == "__main__":
    names, numbers = sys.argv[1:3], [float(word) for word in sys.argv[3:6]]
    relay(device(names[0]), device(names[1]), numbers[0], numbers[1], numbers[2])
