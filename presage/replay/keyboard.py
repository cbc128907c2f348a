"""Keys that control a replay."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from common.messages.requests import PlayerReply, PlayerRequest
from services.recorder.replaying.replay import ReplayControl

if sys.platform != "win32":
    import termios
    import tty

HELP = "space: pause/resume, .: one scan, left/right or h/l: 5 s back/forward, down/up: slower/faster, q: quit"
JUMP_S = 5.0
QUIT = "q"
# Escape sequences of the arrow keys, in both modes of a terminal.
ARROWS = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "l", b"\x1b[D": "h"}
ARROWS |= {code.replace(b"[", b"O"): key for code, key in ARROWS.items()}


def parse_keys(data: bytes) -> list[str]:
    """Parses the bytes sent by a terminal as keys; arrows get a name, all others are their character."""
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
    """The request for a replay in the given state; None if the key has no function."""
    if key == " ":
        return PlayerRequest(action="resume" if state.paused else "pause")
    if key == ".":
        return PlayerRequest(action="step")
    if key in {"h", "l"}:
        position_s = state.position_s + (JUMP_S if key == "l" else -JUMP_S)
        return PlayerRequest(action="seek", value=position_s)
    if key in {"up", "down"}:
        return PlayerRequest(action="rate", value=(state.rate or 1.0) * (2.0 if key == "up" else 0.5))
    return None


@contextmanager
def keyboard(remote: ReplayControl) -> Iterator[bool]:
    """Controls the replay with the keyboard in the block; yields False if standard input is not a usable terminal."""
    if sys.platform == "win32":
        yield False
    else:
        try:
            terminal = sys.stdin.fileno()
            attributes = termios.tcgetattr(terminal)
        except (OSError, ValueError, termios.error):  # standard input is a pipe, a file or closed
            yield False
            return
        if os.tcgetpgrp(terminal) != os.getpgrp():  # reading in a background process would stop it
            yield False
            return
        wake, waker = os.pipe()
        thread = threading.Thread(target=_listen, args=(terminal, wake, remote), name="keyboard", daemon=True)
        try:
            tty.setcbreak(terminal)  # keys come without Enter; Ctrl-C still raises KeyboardInterrupt
            thread.start()
            yield True
        finally:
            termios.tcsetattr(terminal, termios.TCSADRAIN, attributes)
            os.close(waker)
            if thread.ident is not None:
                thread.join(1.0)
            os.close(wake)


def _listen(terminal: int, wake: int, remote: ReplayControl) -> None:
    while True:
        ready, _, _ = select.select([terminal, wake], [], [])
        data = b"" if wake in ready else os.read(terminal, 64)
        if not data:  # the replay has ended, or the terminal was closed
            return
        for key in parse_keys(data):
            if key == QUIT:
                remote.quit()
            elif (request := request_of(key, remote.state())) is not None:
                remote.send(request)
