"""Run the blocks of docs/deployment.md on hosts of their own; ends with the status of `presage goal`. A script.

python tests/system/three_hosts.py PAGE FOLDER
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

from common.processes import end_with_this_process
from lab.fault_injection.hosts import Network, enter_own_namespaces

GOAL = ["-m", "presage", "goal", "15.5", "1.5", "--wait", "--connect", "tcp/10.77.0.1:7447"]


def blocks(page: str) -> list[str]:
    """What is to be typed on each host."""
    section = page[page.index("## Several hosts") :]
    return re.findall(r"```sh\n(.*?)```", section, re.DOTALL)


def main(page: Path, folder: Path) -> int:
    enter_own_namespaces(sys.argv)
    started = []
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PRESAGE_")} | {"PATH": path}
    with Network() as network:
        entering = [[], network.add("robot").entering, network.add("brain").entering]
        try:
            for prefix, block in zip(entering, blocks(page.read_text()), strict=True):
                # `wait` keeps the shell, and so its children's parent, until it is told to end.
                script = "trap 'kill $(jobs -p); wait' TERM\n" + block + "\nwait"
                started.append(
                    subprocess.Popen(
                        [*prefix, "bash", "-c", script],
                        env=environment,
                        cwd=folder,
                        preexec_fn=end_with_this_process(),  # noqa: PLW1509 - one call, before any thread of the child
                    )
                )
            return patient(GOAL, environment, folder)
        finally:
            for shell in started:
                shell.terminate()
            for shell in started:
                shell.wait(30)


def patient(goal: list[str], environment: dict[str, str], folder: Path) -> int:
    """Its status, once there is a controller to speak to."""
    deadline = time.monotonic() + 120
    while True:
        asked = subprocess.run([sys.executable, *goal], env=environment, cwd=folder)
        if asked.returncode == 0 or time.monotonic() > deadline:
            return asked.returncode


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
