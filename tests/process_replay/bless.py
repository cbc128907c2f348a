"""`make bless`: show what services answer differently than their references, and make that the new reference.

python -m tests.process_replay.bless                 all of them
python -m tests.process_replay.bless controller      one
python -m tests.process_replay.bless --show          show, write nothing
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

SHOWN = 12  # differences of a service


def bless(
    name: str, rows: list[Row], folder: Path = FOLDER, *, write: bool = True, say: Callable[[str], object] = print
) -> bool:
    """Whether there was anything to accept; says what before it writes."""
    path = folder / f"{name}.jsonl"
    old = reference.read(name, folder)
    if old:
        differences = list(reference.compare(old, rows))
        if not differences:
            say(f"{name}: as before")
            return False
        say(reference.report(name, differences, SHOWN))
    else:
        say(f"{name}: no reference yet; {len(rows)} messages")
    if write:
        before = path.read_text().splitlines() if old else []
        after = reference.write(name, reference.merged(old, rows), folder).read_text().splitlines()
        say(f"{name}: written to {path.name}, {len(set(after) - set(before))} of {len(after)} lines new; see git diff")
    return True


def main(arguments: list[str], sessions: Mapping[str, Callable[..., list[Row]]] = SESSIONS) -> None:
    """Of the services named, or all."""
    names = [argument for argument in arguments if argument != "--show"] or list(sessions)
    if unknown := set(names) - set(sessions):
        sys.exit(f"no session {', '.join(sorted(unknown))}: choose from {', '.join(sessions)}")
    set_up_logging("error", as_json=False)
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            bless(name, sessions[name](Path(folder)), write="--show" not in arguments)


if __name__ == "__main__":
    main(sys.argv[1:])
