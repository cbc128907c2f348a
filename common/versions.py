"""Provenance of a result: package versions, the protocol version, the commit of a checkout, and the command."""

from __future__ import annotations

import functools
import hashlib
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


ROOT = Path(__file__).resolve().parent.parent
_run = functools.partial(
    subprocess.run, cwd=ROOT, capture_output=True, text=True, errors="replace", timeout=5, check=True
)


@functools.cache
def commit() -> str:
    """The commit of the checkout, followed by + if files were changed; 'unknown' outside a checkout."""
    if not (ROOT / ".git").exists():
        return "unknown"
    try:
        head = _run(["git", "rev-parse", "--short=12", "HEAD"]).stdout.strip()
        dirty = _run(["git", "status", "--porcelain", "--untracked-files=no"]).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return head + ("+" if dirty else "")


@functools.cache
def checkout_state() -> str:
    """Names one state of the code: the commit, followed by + and a digest if files outside docs/ were changed.

    Results are written into docs/, so a run that was interrupted changes the files there.
    """
    head = commit().rstrip("+")
    if head == commit():
        return head
    changes = _run(["git", "diff", "--binary", "HEAD", "--", ".", ":!docs"]).stdout
    return f"{head}+{hashlib.sha256(changes.encode()).hexdigest()[:12]}" if changes else head


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
