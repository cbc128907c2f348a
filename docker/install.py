"""Into an image: packages of pyproject.toml, at the versions of constraints.txt, less what nobody imports.

Examples:
  python install.py                    what every service needs
  python install.py simulator viewer   and what these extras add
  WHEEL_INDEX=URL python install.py estimator

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
# Robots to play with, headers, programs of torch's own tests: half of what the two largest packages weigh; and AVIF.
UNUSED = (
    "pybullet_data", "pybullet_envs", "pybullet_examples", "pybullet_robots", "pybullet_utils", "eglRenderer*.so",
    "torch/bin/test_*", "torch/bin/*Test", "torch/bin/protoc*", "torch/include", "torch/test", "torch/share",
    "PIL/_avif*", "pillow.libs/libavif*",
)  # fmt: skip


def requirements(extras: list[str]) -> list[str]:
    """Of these extras, and of those they name; of none: of the project itself."""
    project = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]
    found: list[str] = [] if extras else list(project["dependencies"])
    for extra in extras:
        for line in project["optional-dependencies"][extra]:
            own = line.startswith("presage[")
            found += requirements(line[len("presage[") : -1].split(",")) if own else [line]
    return found


def main() -> None:
    """Install, then remove tests and what else is not used at run time."""
    index = os.environ.get("WHEEL_INDEX", "")
    pip = [sys.executable, "-m", "pip", "install", "--no-cache-dir", "--constraint", str(HERE / "constraints.txt")]
    pip += ["--extra-index-url", index] if index else []
    subprocess.run([*pip, *requirements(sys.argv[1:])], check=True)  # noqa: S603 - our own words
    for packages in {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib")}:
        for pattern in (*UNUSED, "*/tests", "*/*/tests"):
            for path in packages.glob(pattern):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


if __name__ == "__main__":
    main()
