"""Installs the packages of dependency groups of pyproject.toml into an image, at the versions of constraints.txt.

Examples:
  python install.py router             what every service needs
  python install.py simulator
  WHEEL_INDEX=URL python install.py paper

"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import tomllib

HERE = Path(__file__).resolve().parent
STRIP = HERE / "strip"  # a folder with the program and its libraries
# Not used by the services, and large: tests, example robots, headers, build tools, image formats, fonts, lexers,
# subpackages of scipy, and the compiled copies of fontTools' modules.
UNUSED = (
    "**/tests", "**/*.py[ix]", "**/*.a",
    "pybullet_*", "eglRenderer*.so",
    "torch/bin/test_*", "torch/bin/*Test", "torch/bin/protoc*", "torch/include", "torch/test", "torch/share",
    "PIL/_avif*", "pillow.libs/libavif*", "PIL/_imagingft*", "pillow.libs/libharfbuzz*", "pillow.libs/libfreetype*",
    "numpy/distutils", "numpy/_core/include", "numpy/_core/_simd*",
    "scipy/cluster", "scipy/datasets", "scipy/fft", "scipy/fftpack", "scipy/integrate", "scipy/interpolate",
    "scipy/io", "scipy/odr", "scipy/optimize", "scipy/signal", "scipy/stats",
    "fontTools/*/*.so", "matplotlib/mpl-data/fonts/[ap]*", "pygments/lexers/[!_p]*", "pygments/lexers/__pycache__",
    "pygments/lexers/_*_builtins.py", "tzdata/zoneinfo",
)  # fmt: skip
# Half of these libraries is symbols for debuggers. `strip` damages those that patchelf has changed, such as numpy's.
WITH_SYMBOLS = (
    "pybullet*.so", "zenoh/*.so", "zstandard/*.so", "kiwisolver/*.so", "lz4/*/*.so", "yaml/*.so",
    "cryptography/hazmat/bindings/*.so",
)  # fmt: skip


def requirements(group: str) -> list[str]:
    """The requirements of a dependency group, and of the groups that it includes."""
    found: list[str] = []
    for entry in tomllib.loads((HERE / "pyproject.toml").read_text())["dependency-groups"][group]:
        found += requirements(entry["include-group"]) if isinstance(entry, dict) else [entry]
    return found


def find(*patterns: str) -> list[Path]:
    """The installed files and folders that match one of the patterns."""
    folders = {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib")}
    return [path for folder in folders for pattern in patterns for path in folder.glob(pattern)]


def main() -> None:
    """Installs the groups named on the command line, then removes unused parts and symbols for debuggers."""
    index = os.environ.get("WHEEL_INDEX", "")
    pip = [sys.executable, "-m", "pip", "install", "--no-cache-dir", "--constraint", str(HERE / "constraints.txt")]
    pip += ["--extra-index-url", index] if index else []
    needed = [each for group in sys.argv[1:] for each in requirements(group)]
    stripped = find(*WITH_SYMBOLS)  # in a layer below: stripping them again would add a copy to the image
    subprocess.run([*pip, *needed], check=True)  # noqa: S603 - the arguments come from the Dockerfile
    for path in find(*UNUSED):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    for path in set(find(*WITH_SYMBOLS)).difference(stripped):
        subprocess.run([STRIP / "strip", path], check=True, env={"LD_LIBRARY_PATH": str(STRIP)})  # noqa: S603


if __name__ == "__main__":
    main()
