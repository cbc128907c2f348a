"""Runs the shell blocks of docs/deployment.md on three hosts; exits with the status of `presage goal`.

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

GOAL = ["-m", "presage", "--connect", "tcp/10.77.0.1:7447", "goal", "6.5", "1.5", "--wait"]


def shell_blocks(page: str) -> list[str]:
    """The commands for each host, from the page's section on several hosts."""
    section = page[page.index("## Several hosts") :]
    return re.findall(r"```sh\n(.*?)```", section, re.DOTALL)


def main(page: Path, folder: Path) -> int:
    enter_own_namespaces(sys.argv)
    started = []
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PRESAGE_")} | {"PATH": path}
    with Network() as network:
        prefixes = [[], network.add("robot").command_prefix, network.add("brain").command_prefix]
        try:
            for prefix, block in zip(prefixes, shell_blocks(page.read_text()), strict=True):
                # `wait` keeps the shell alive until it gets SIGTERM.
                script = "trap 'kill $(jobs -p); wait' TERM\n" + block + "\nwait"
                started.append(
                    subprocess.Popen(
                        [*prefix, "bash", "-c", script],
                        env=environment,
                        cwd=folder,
                        preexec_fn=end_with_this_process(),
                    )
                )
            return retry_goal(GOAL, environment, folder)
        finally:
            for shell in started:
                shell.terminate()
            for shell in started:
                shell.wait(30)


def retry_goal(goal: list[str], environment: dict[str, str], folder: Path) -> int:
    """Repeats the goal command until it succeeds or 120 s have passed. Returns its last exit status."""
    deadline = time.monotonic() + 120
    while True:
        attempt = subprocess.run([sys.executable, *goal], env=environment, cwd=folder)
        if attempt.returncode == 0 or time.monotonic() > deadline:
            return attempt.returncode


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
