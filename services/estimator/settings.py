"""What the estimator can be told."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.config import POSE_TEXT, ServiceSettings


class EstimatorSettings(ServiceSettings):
    """Free-energy estimator: from each scan a belief about the pose, and the scan it expected.

    Examples:
      python -m services.estimator                                    the paper's preset in the corridor
      python -m services.estimator --world my.yaml --models trained   your world, your weights
      python -m services.estimator --initial-pose 3,1.5,90            start from a known pose (m, m, deg)
      PRESAGE_ALPHA=0.001 python -m services.estimator --print-config

    """

    service: ClassVar[str] = "estimator"

    world: Annotated[str, Field(description="shipped world or world file the model was trained for")] = "corridor"
    preset: Annotated[Literal["paper"], Field(description="paper: the decoder and descent of the paper")] = "paper"
    models: Annotated[Path | None, Field(description="folder of weights; none: the shipped ones")] = None
    initial_pose: Annotated[str, Field(pattern=POSE_TEXT, description="x,y[,yaw_deg]; none: the map's centre")] = ""
    alpha: Annotated[float, Field(gt=0, lt=1, description="step size of perception, m²")] = 2e-4
    beta: Annotated[
        float, Field(ge=0, lt=10, description="the goal's attraction in perception (eq. 3); 0: the belief is unbiased")
    ] = 0.0
    iterations: Annotated[int, Field(ge=1, le=1000, description="gradient steps a scan; the paper: 1")] = 10
