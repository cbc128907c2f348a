"""`make platforms`: checks that every dependency has a wheel on each platform, and prints the download sizes.

Rows "demo" are for what `make demo` installs. Rows "all" add every extra; they have no sizes, because those depend on
the build of PyTorch.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PLATFORMS = {
    "Linux x86_64": "x86_64-manylinux_2_28",
    "Linux aarch64": "aarch64-manylinux_2_28",
    "macOS 14 arm64": "aarch64-apple-darwin",
    "Windows x86_64": "x86_64-pc-windows-msvc",
}
VERSIONS = ("3.10", "3.11", "3.12", "3.13", "3.14")


def download_size(platform: str, version: str, *options: str) -> float:
    """Size of all wheels in MB, or its upper bound if several wheels of a package fit.

    Raises RuntimeError if a package has no wheel.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "pylock.toml"
        command = [sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--only-binary", ":all:", *options]
        command += ["--python-platform", platform, "--python-version", version, "-c", "constraints.txt"]
        command += ["-o", str(out), "pyproject.toml"]
        environment = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": "14.0"}  # PyTorch has no wheels for older macOS
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        if done.returncode != 0:
            raise RuntimeError(done.stderr)
        packages = out.read_text(encoding="utf-8").split("[[packages]]")[1:]
    return sum(max(map(int, re.findall(r"size = (\d+)", package))) for package in packages) / 1e6


def main() -> None:
    errors = []
    print("|", *VERSIONS, "", sep=" | ")
    print("|---" * (len(VERSIONS) + 1) + "|")
    for name, platform in PLATFORMS.items():
        for row, options in (("demo", ()), ("all", ("--all-extras",))):
            cells = []
            for version in VERSIONS:
                try:
                    size = download_size(platform, version, *options)
                    cells.append("wheels" if options else f"{size:.0f} MB")
                except RuntimeError as error:
                    errors.append(f"{name}, Python {version}, {row}: {error}")
                    cells.append("no")
            print(f"| {name}, {row}", *cells, "", sep=" | ", flush=True)
    if errors:
        sys.exit("\n".join(errors))


if __name__ == "__main__":
    main()
