"""Provenance of a result: package versions, the protocol version, the commit of a checkout, and the command."""

from __future__ import annotations

import functools
import importlib.metadata
import platform
import shlex
import subprocess
import sys
from pathlib import Path

# Version of the messages, requests and keys. Increase it when an older service would misread a newer one's messages; a
# new field with a default, a new topic or a new queryable does not require it. Services of different protocol versions
# do not run together (common/runtime/protocol_check.py).
PROTOCOL = 1

PACKAGES = (
    "presage",
    "eclipse-zenoh",
    "msgpack",
    "numpy",
    "scipy",
    "numba",
    "shapely",
    "pydantic",
    "mcap",
    "torch",
    "pybullet",
)


@functools.cache
def commit() -> str:
    """The commit of the checkout, followed by + if files were changed; 'unknown' outside a checkout."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return "unknown"
    try:
        run = functools.partial(subprocess.run, cwd=root, capture_output=True, text=True, timeout=5, check=True)
        head = run(["git", "rev-parse", "--short=12", "HEAD"]).stdout.strip()
        dirty = run(["git", "status", "--porcelain", "--untracked-files=no"]).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return head + ("+" if dirty else "")


def presage_command() -> str:
    """The command `presage` that runs, quoted so that it can be pasted into a shell."""
    return shlex.join(["presage", *sys.argv[1:]])


@functools.cache
def versions() -> dict[str, str]:
    """Versions of Python and of the installed packages of `PACKAGES`, and the commit."""
    found = {"python": platform.python_version(), "commit": commit()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
