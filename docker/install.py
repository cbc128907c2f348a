"""Installs the packages of dependency groups of pyproject.toml into an image, at the versions of constraints.txt.

Examples:
  python install.py router             what every service needs
  python install.py simulator
  WHEEL_INDEX=URL python install.py paper

"""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import sysconfig
from pathlib import Path

import tomllib

HERE = Path(__file__).resolve().parent
# Not used by the services, and large: example robots of pybullet, headers and test programs of PyTorch, Pillow's AVIF
# codec and fonts, build tools of numpy, subpackages of scipy, variable fonts, and the compiled copies of modules of fontTools.
UNUSED = (
    "pybullet_data", "pybullet_envs", "pybullet_examples", "pybullet_robots", "pybullet_utils", "eglRenderer*.so",
    "torch/bin/test_*", "torch/bin/*Test", "torch/bin/protoc*", "torch/include", "torch/test", "torch/share",
    "PIL/_avif*", "pillow.libs/libavif*", "PIL/_imagingft*", "pillow.libs/libharfbuzz*", "pillow.libs/libfreetype*",
    "fontTools/*/*.so", "fontTools/feaLib", "fontTools/qu2cu", "fontTools/ufoLib", "fontTools/varLib",
    "pygments/lexers/_*_builtins.py", "numpy/distutils", "numpy/_core/include", "numpy/_core/_simd*",
    "scipy/cluster", "scipy/datasets", "scipy/fft", "scipy/fftpack", "scipy/integrate", "scipy/interpolate",
    "scipy/io", "scipy/odr", "scipy/optimize", "scipy/signal", "scipy/stats",
)  # fmt: skip


def requirements(group: str) -> list[str]:
    """The requirements of a dependency group, and of the groups that it includes."""
    found: list[str] = []
    for entry in tomllib.loads((HERE / "pyproject.toml").read_text())["dependency-groups"][group]:
        found += requirements(entry["include-group"]) if isinstance(entry, dict) else [entry]
    return found


def strip_symbols(library: Path) -> None:
    """Removes the symbols for debuggers: in a 64-bit ELF file, all that follows the segments that are loaded.

    In pybullet's library they are 126 of 134 MB. The image has no `strip`.
    """
    data = library.read_bytes()
    if data[:6] != b"\x7fELF\x02\x01":
        return
    (table,), (entry_size, count) = struct.unpack_from("<Q", data, 32), struct.unpack_from("<HH", data, 54)
    end = table + count * entry_size
    for entry in range(table, end, entry_size):
        offset, _, _, size = struct.unpack_from("<4Q", data, entry + 8)
        end = max(end, offset + size)
    if end == len(data):  # stripped before, in another layer of the image
        return
    header = bytearray(data[:64])
    struct.pack_into("<Q", header, 40, 0)  # no table of sections
    struct.pack_into("<HH", header, 60, 0, 0)
    library.write_bytes(header + data[64:end])


def main() -> None:
    """Installs the groups named on the command line, then removes tests, unused parts and debug symbols."""
    index = os.environ.get("WHEEL_INDEX", "")
    pip = [sys.executable, "-m", "pip", "install", "--no-cache-dir", "--constraint", str(HERE / "constraints.txt")]
    pip += ["--extra-index-url", index] if index else []
    needed = [each for group in sys.argv[1:] for each in requirements(group)]
    subprocess.run([*pip, *needed], check=True)  # noqa: S603 - the arguments come from the Dockerfile
    for packages in {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib")}:
        for pattern in (*UNUSED, "*/tests", "*/*/tests"):
            for path in packages.glob(pattern):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for library in packages.rglob("*.so*"):
            strip_symbols(library)


if __name__ == "__main__":
    main()
