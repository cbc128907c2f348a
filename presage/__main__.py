"""`presage`, and `python -m presage`. To import the commands takes a moment, and Ctrl-C may come meanwhile."""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point."""
    try:
        from presage.cli.main import main as run  # noqa: PLC0415
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
