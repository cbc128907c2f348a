"""Package versions, the protocol version, and the commit of a checkout."""

from __future__ import annotations

import functools
import importlib.metadata
import platform
import subprocess
from pathlib import Path

# Of messages, requests and keys. Raised when an older service would misread a newer one's; a new field with a default,
# a new topic or a new queryable is no reason. Services of different protocols refuse one another (compatibility.py).
PROTOCOL = 1

PACKAGES = ("presage", "eclipse-zenoh", "msgpack", "numpy", "pydantic", "mcap", "torch", "pybullet")


@functools.cache
def commit() -> str:
    """The checkout's commit, with + where files differ from it; 'unknown' outside a checkout."""
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


@functools.cache
def versions() -> dict[str, str]:
    """Versions of Python, presage and the packages that matter, where they are installed."""
    found = {"python": platform.python_version(), "commit": commit()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
