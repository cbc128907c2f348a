"""Keys that steer a replay."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager

from common.messages.requests import PlayerReply, PlayerRequest
from services.recorder.replaying.replay import ReplayControl

HELP = "space pause/go on, . one scan, left/right or h/l 5 s back/on, down/up slower/faster, q quit"
JUMP = 5.0  # s
QUIT = "q"
# What a terminal sends for the arrows, in both of its modes.
ARROWS = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "l", b"\x1b[D": "h"}
ARROWS |= {code.replace(b"[", b"O"): key for code, key in ARROWS.items()}


def pressed(data: bytes) -> list[str]:
    """The keys in what a terminal sent; what is none of them is a key by its own letter."""
    keys: list[str] = []
    while data:
        if data[:3] in ARROWS:
            keys.append(ARROWS[data[:3]])
            data = data[3:]
        else:
            keys.append(chr(data[0]))
            data = data[1:]
    return keys


def request_of(key: str, state: PlayerReply) -> PlayerRequest | None:
    """What a key asks of a replay in this state; None: nothing."""
    if key == " ":
        return PlayerRequest(action="resume" if state.paused else "pause")
    if key == ".":
        return PlayerRequest(action="step")
    if key in {"h", "l"}:
        place = state.position_s + (JUMP if key == "l" else -JUMP)
        return PlayerRequest(action="seek", value=place)
    if key in {"up", "down"}:
        return PlayerRequest(action="rate", value=(state.rate or 1.0) * (2.0 if key == "up" else 0.5))
    return None


@contextmanager
def keyboard(remote: ReplayControl) -> Iterator[bool]:
    """Keys of the terminal on standard input, if it is one, steer the replay; whether it is."""
    try:
        terminal = sys.stdin.fileno()
        before = termios.tcgetattr(terminal)
    except (OSError, ValueError, termios.error):  # a pipe, a file, nothing
        yield False
        return
    if os.tcgetpgrp(terminal) != os.getpgrp():  # in the background, where reading would stop us
        yield False
        return
    wake, waker = os.pipe()
    thread = threading.Thread(target=_listen, args=(terminal, wake, remote), name="keyboard", daemon=True)
    try:
        tty.setcbreak(terminal)  # Ctrl-C stays what it is
        thread.start()
        yield True
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
        os.close(waker)
        if thread.ident is not None:
            thread.join(1.0)
        os.close(wake)


def _listen(terminal: int, wake: int, remote: ReplayControl) -> None:
    while True:
        ready, _, _ = select.select([terminal, wake], [], [])
        data = b"" if wake in ready else os.read(terminal, 64)
        if not data:  # the end of the replay, or of the terminal
            return
        for key in pressed(data):
            if key == QUIT:
                remote.quit()
            elif (request := request_of(key, remote.state())) is not None:
                remote.send(request)
