"""Trajectories in TUM format, for evo.

Format: one pose per line, `timestamp x y z qx qy qz qw` in s and m; comment lines begin with #
(https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats). The timestamps are the stamps of the messages, so that
belief and truth of a scan match exactly. evo requires ascending timestamps: when a restarted simulation uses stamps
again, the following lines go into NAME-2.tum and so on.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

import numpy as np
from rich.console import Console

from common.errors import UserError
from common.messages.definitions import Belief, Odom, Truth
from common.messages.topics import BELIEF, ODOM, TRUTH
from common.writing import complete_files
from presage.recordings.selection import entries, keys_of, refuse_to_overwrite, robot_of, with_progress
from presage.terminal.output import make_folder
from services.recorder.reader import Recording

TOPICS = (BELIEF, TRUTH, ODOM)
FRAMES = {"belief": "map", "truth": "map", "odom": "odom"}


class TrajectoryWriter:
    """Writes the poses of one topic; starts a new file whenever the stamps go back."""

    def __init__(self, folder: Path, name: str, stack: ExitStack) -> None:
        """The files NAME.tum, NAME-2.tum and so on are written into ``folder`` and closed by ``stack``."""
        self.folder, self.name, self.rows = folder, name, dict[str, int]()
        self._stack = stack
        self._stream: TextIO | None = None
        self._file = ""
        self._last_ns = -1

    def add(self, stamp_ns: int, x: float, y: float, yaw: float) -> None:
        """Adds a pose; ignores a repeated message with the same stamp."""
        if self._stream is None or stamp_ns < self._last_ns:
            self._stream = self._open_next()
        elif stamp_ns == self._last_ns:
            return
        self._last_ns = stamp_ns
        seconds, rest = divmod(stamp_ns, 1_000_000_000)
        self._stream.write(
            f"{seconds}.{rest:09d} {x:.9f} {y:.9f} 0 0 0 {np.sin(yaw / 2):.12f} {np.cos(yaw / 2):.12f}\n"
        )
        self.rows[self._file] += 1

    def _open_next(self) -> TextIO:
        number = len(self.rows) + 1
        self._file = f"{self.name}.tum" if number == 1 else f"{self.name}-{number}.tum"
        self.rows[self._file] = 0
        stream = self._stack.enter_context((self.folder / self._file).open("w", encoding="ascii"))
        stream.write(f"# base_link in {FRAMES[self.name]}: timestamp x y z qx qy qz qw\n")
        return stream


def export_tum(
    recording: Recording, folder: Path, robot: str, console: Console, *, localised_only: bool, force: bool
) -> dict[str, int]:
    """Writes belief.tum, truth.tum and odom.tum into ``folder``; returns the number of poses by file name.

    ``localised_only`` leaves out beliefs that are not in state tracking. Raises UserError if there are no poses, if
    nothing can be written, or if the folder is not empty and ``force`` is not given.
    """
    name = robot_of(recording, robot)
    keys = keys_of(recording, name, *TOPICS)
    if not keys:
        raise UserError(f"{recording.path}: neither belief nor truth nor odom in it, so there is no trajectory")
    make_folder(folder)
    refuse_to_overwrite(sorted(folder.iterdir())[:1], force=force)
    counts = recording.counts
    with complete_files(folder, folder) as partial, ExitStack() as stack:
        files = {topic.name: TrajectoryWriter(partial, topic.name, stack) for topic in keys.values()}
        messages = with_progress(entries(recording, name, *TOPICS), sum(counts[key] for key in keys), "tum", console)
        for topic, message, _ in messages:
            assert isinstance(message, Belief | Truth | Odom)  # noqa: S101 - the message types of TOPICS
            if localised_only and isinstance(message, Belief) and message.state != "tracking":
                continue
            files[topic.name].add(message.stamp_ns, message.pose.x, message.pose.y, message.pose.yaw)
    return {file: rows for trajectory in files.values() for file, rows in trajectory.rows.items()}
