"""The command `presage`, also started as `python -m presage`."""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point of the command `presage`."""
    try:
        # Importing the commands takes a moment, during which Ctrl-C should end the program without a traceback.
        from presage.cli.main import main as run
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
