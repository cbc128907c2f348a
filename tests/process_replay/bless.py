"""`make bless`: shows where services answer differently from their references, and writes new references.

python -m tests.process_replay.bless                 all services
python -m tests.process_replay.bless controller      one service
python -m tests.process_replay.bless --show          only show the differences
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from common.log import set_up_logging
from tests.process_replay import reference
from tests.process_replay.reference import FOLDER, Row
from tests.process_replay.sessions import SESSIONS

MAX_SHOWN_DIFFERENCES = 12  # per service


def bless(
    name: str, rows: list[Row], folder: Path = FOLDER, *, write: bool = True, report: Callable[[str], object] = print
) -> bool:
    """Reports the differences and writes the new reference. Returns whether there were any differences."""
    path = folder / f"{name}.jsonl"
    old = reference.read(name, folder)
    if old:
        differences = list(reference.compare(old, rows))
        if not differences:
            report(f"{name}: unchanged")
            return False
        report(reference.report(name, differences, MAX_SHOWN_DIFFERENCES))
    else:
        report(f"{name}: no reference yet; {len(rows)} messages")
    if write:
        before = path.read_text().splitlines() if old else []
        after = reference.write(name, reference.merged(old, rows), folder).read_text().splitlines()
        report(
            f"{name}: written to {path.name}, {len(set(after) - set(before))} of {len(after)} lines new; see git diff"
        )
    return True


def main(arguments: list[str], sessions: Mapping[str, Callable[..., list[Row]]] = SESSIONS) -> None:
    """Updates the references of the named services, or of all."""
    names = [argument for argument in arguments if argument != "--show"] or list(sessions)
    if unknown := set(names) - set(sessions):
        sys.exit(f"no session {', '.join(sorted(unknown))}: choose from {', '.join(sessions)}")
    set_up_logging("error", as_json=False)
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            bless(name, sessions[name](Path(folder)), write="--show" not in arguments)


if __name__ == "__main__":
    main(sys.argv[1:])
