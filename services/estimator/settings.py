"""Settings of the estimator."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.geometry.pose_text import POSE_TEXT
from common.runtime.config import ServiceSettings

ROBOT_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_PATTERN = r"[A-Za-z0-9_.*?-]{1,64}"


class EstimatorSettings(ServiceSettings):
    """Estimator: from each scan a belief about the pose, and the scan it expected.

    Examples:
      python -m services.estimator                                    preset precise in the corridor
      python -m services.estimator --estimator particle-filter        another one, on the same topics
      python -m services.estimator --world office --model exact       rays cast in the world itself, nothing learned
      python -m services.estimator --world my.yaml --models trained   your world, your weights
      python -m services.estimator --initial-pose 3,1.5,90            start from a known pose (m, m, deg)
      python -m services.estimator --robots robot-1,robot-2           one process for several robots
      python -m services.estimator --robots 'robot-*' --max-robots 20 for each that appears, 20 at most
      PRESAGE_ESTIMATOR=paper python -m services.estimator --print-config

    """

    service: ClassVar[str] = "estimator"
    private: ClassVar[frozenset[str]] = frozenset({"max_robots", "forget"})

    robots: Annotated[
        str,
        Field(
            pattern=rf"^$|^{_PATTERN}(,{_PATTERN})*$",
            description="names or patterns (* and ?), comma-separated: robots that this process serves; none: --robot",
        ),
    ] = ""
    max_robots: Annotated[int, Field(ge=1, le=1000, description="that one process serves")] = 100
    forget: Annotated[
        float, Field(gt=0, le=1e6, description="s without scan or simulator, after which one of several is forgotten")
    ] = 60.0

    world: Annotated[str, Field(description="shipped world, world file or ROS map.yaml the model was trained for")] = (
        "corridor"
    )
    estimator: Annotated[
        Literal["precise", "paper", "particle-filter", "amcl-defaults"],
        Field(description="precise; paper: Burghardt & Lanillos 2021; particle-filter: AMCL's design, tuned or not"),
    ] = "precise"
    model: Annotated[str, Field(description="of precise: learned, exact, or a file of weights")] = "learned"
    models: Annotated[Path | None, Field(description="folder of weights; none: the shipped ones")] = None
    prior: Annotated[
        Literal["motion", "odometry", "command"],
        Field(
            description="what tells of motion between scans; motion: the last scans alone; "
            "command: runs are not repeatable to the byte, for it races with the scan"
        ),
    ] = "motion"
    sigma: Annotated[
        float | None, Field(gt=0, lt=10, description="m, the scanner's noise; none: as the scan says, else 0.02")
    ] = None
    seed: Annotated[int, Field(ge=0, le=2**31, description="of particles")] = 0
    initial_pose: Annotated[
        str, Field(pattern=POSE_TEXT, description="x,y[,yaw_deg]; none: nothing is known (paper: the map's centre)")
    ] = ""
    alpha: Annotated[
        float, Field(gt=0, lt=1, description="paper: step size of perception along the longest axis, m²")
    ] = 2e-3
    beta: Annotated[
        float, Field(ge=0, lt=10, description="paper: the goal's attraction in perception (eq. 3); 0: unbiased belief")
    ] = 0.0
    iterations: Annotated[int, Field(ge=1, le=1000, description="paper: gradient steps a scan; the paper: 1")] = 10
