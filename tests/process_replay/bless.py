"""`make bless`: shows where services answer differently from their references, and writes new references.

python -m tests.process_replay.bless                 all services
python -m tests.process_replay.bless controller      one service
python -m tests.process_replay.bless --show          only show the differences
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from common.log import set_up_logging
from tests.process_replay import reference
from tests.process_replay.reference import FOLDER, Row
from tests.process_replay.sessions import SESSIONS

MAX_SHOWN_DIFFERENCES = 20  # per service


def bless(name: str, rows: list[Row], folder: Path = FOLDER, *, write: bool = True) -> list[str]:
    """Writes the new reference if it differs from the old one; returns the differences."""
    old = reference.read(name, folder)
    differences = reference.compare(old, rows)
    if differences and write:
        reference.write(name, reference.merged(old, rows), folder)
    return differences


def main(arguments: list[str]) -> None:
    """Updates the references of the named services, or of all."""
    names = [argument for argument in arguments if argument != "--show"] or list(SESSIONS)
    if unknown := set(names) - set(SESSIONS):
        sys.exit(f"no session {', '.join(sorted(unknown))}: choose from {', '.join(SESSIONS)}")
    set_up_logging("error", as_json=False)
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            differences = bless(name, SESSIONS[name](Path(folder)), write="--show" not in arguments)
        print(f"{name}: {len(differences)} differences", *differences[:MAX_SHOWN_DIFFERENCES], sep="\n  ")


if __name__ == "__main__":
    main(sys.argv[1:])
