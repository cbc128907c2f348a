"""A slow or lossy link.

The relay creates two network devices and passes every frame from one to the other after a delay, or loses it. Frames
may overtake one another, as with netem.
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
MAX_FRAME_BYTES = 65_536


def device(name: str) -> int:
    """Creates a network device. Returns its file descriptor."""
    file = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(file, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TAP | IFF_NO_PI))
    return file


def relay(near: int, far: int, delay: float, jitter: float, loss: float) -> None:
    """Passes frames between two devices until killed; delay and jitter in s, loss as a share of 1."""
    rng, other = random.Random(0), {near: far, far: near}
    waiting: list[tuple[float, int, int, bytes]] = []
    number = 0
    while True:
        now = time.monotonic()
        while waiting and waiting[0][0] <= now:
            _, _, target, frame = heapq.heappop(waiting)
            try:
                os.write(target, frame)
            except OSError:  # the device is not up yet or its queue is full: the frame is lost
                continue
        until = waiting[0][0] - now if waiting else None
        for source in select.select([near, far], [], [], until)[0]:
            frame = os.read(source, MAX_FRAME_BYTES)
            if rng.random() < loss:
                continue
            number += 1
            due = time.monotonic() + max(0.0, delay + rng.uniform(-jitter, jitter))
            heapq.heappush(waiting, (due, number, other[source], frame))


if __name__ == "__main__":
    names, numbers = sys.argv[1:3], [float(word) for word in sys.argv[3:6]]
    relay(device(names[0]), device(names[1]), numbers[0], numbers[1], numbers[2])
