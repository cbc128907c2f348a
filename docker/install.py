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
# Not used by the services, and large: example robots of pybullet, headers and test programs of PyTorch, Pillow's AVIF
# codec, and subpackages of scipy.
UNUSED = (
    "pybullet_data", "pybullet_envs", "pybullet_examples", "pybullet_robots", "pybullet_utils", "eglRenderer*.so",
    "torch/bin/test_*", "torch/bin/*Test", "torch/bin/protoc*", "torch/include", "torch/test", "torch/share",
    "PIL/_avif*", "pillow.libs/libavif*",
    "scipy/cluster", "scipy/datasets", "scipy/fft", "scipy/fftpack", "scipy/integrate", "scipy/interpolate",
    "scipy/io", "scipy/odr", "scipy/optimize", "scipy/signal", "scipy/stats",
)  # fmt: skip


def requirements(group: str) -> list[str]:
    """The requirements of a dependency group, and of the groups that it includes."""
    found: list[str] = []
    for entry in tomllib.loads((HERE / "pyproject.toml").read_text())["dependency-groups"][group]:
        found += requirements(entry["include-group"]) if isinstance(entry, dict) else [entry]
    return found


def main() -> None:
    """Installs the groups named on the command line, then removes tests and other unused files."""
    index = os.environ.get("WHEEL_INDEX", "")
    pip = [sys.executable, "-m", "pip", "install", "--no-cache-dir", "--constraint", str(HERE / "constraints.txt")]
    pip += ["--extra-index-url", index] if index else []
    needed = [each for group in sys.argv[1:] for each in requirements(group)]
    subprocess.run([*pip, *needed], check=True)  # noqa: S603 - the arguments come from the Dockerfile
    for packages in {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib")}:
        for pattern in (*UNUSED, "*/tests", "*/*/tests"):
            for path in packages.glob(pattern):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


if __name__ == "__main__":
    main()
