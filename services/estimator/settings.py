"""Settings of the estimator."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.errors import UserError
from common.geometry.pose_text import POSE_PATTERN
from common.messages.topics import ROBOT_NAME_PATTERN
from common.names import split_names
from common.runtime.robot_settings import MotionLimitSettings

PRESET_OF_SETTING = {"model": "precise", "sigma": "precise", "alpha": "paper", "iterations": "paper"}
_PATTERN = r"[A-Za-z0-9_.*?-]{1,64}"  # name of a robot, or a pattern of names


class EstimatorSettings(MotionLimitSettings):
    """Estimator: publishes for each scan a belief about the pose, and the scan it expected.

    Examples:
      python -m services.estimator                                    preset precise in the corridor
      python -m services.estimator --estimator particle-filter        another estimator, on the same topics
      python -m services.estimator --world office --model exact       casts rays in the world itself, without learning
      python -m services.estimator --world my.yaml --models trained   your world, with weights from folder trained
      python -m services.estimator --world my.yaml --learn refine     improves these weights while driving
      python -m services.estimator --initial-pose 3,1.5,90            starts from a known pose (m, m, deg)
      python -m services.estimator --robots robot-1,robot-2           one process for several robots
      python -m services.estimator --robots 'robot-*' --max-robots 20 one process for every such robot, at most 20
      PRESAGE_ESTIMATOR=paper python -m services.estimator --print-config

    """

    service: ClassVar[str] = "estimator"
    private: ClassVar[frozenset[str]] = frozenset({"max_robots", "forget", "saved_models"})

    robots: Annotated[
        str,
        Field(
            pattern=rf"^$|^{_PATTERN}(,{_PATTERN})*$",
            description="robots that this process serves: names or patterns (* and ?), comma-separated; "
            "empty for the one of --robot",
        ),
    ] = ""
    max_robots: Annotated[int, Field(ge=1, le=1000, description="most robots that one process serves")] = 100
    forget: Annotated[
        float,
        Field(gt=0, le=1e6, description="s without scan or simulator after which one of several robots is dropped"),
    ] = 60.0

    world: Annotated[
        str, Field(description="shipped world, world file or ROS map.yaml for which the model was trained")
    ] = "corridor"
    estimator: Annotated[
        Literal["precise", "paper", "particle-filter", "amcl-defaults"],
        Field(
            description="precise; paper: Burghardt & Lanillos 2021; particle-filter: tuned AMCL; amcl-defaults: untuned"
        ),
    ] = "precise"
    model: Annotated[str, Field(description="model of precise: learned, exact, or a file of weights")] = "learned"
    models: Annotated[
        Path | None,
        Field(description="folder of weights; defaults to your trained ones for the world, else the shipped ones"),
    ] = None
    learn: Annotated[
        Literal["none", "refine", "follow"],
        Field(
            description="refine: precise improves the model while it is tracking; follow: uses what another estimator "
            "publishes on `field`, as in a replay"
        ),
    ] = "none"
    saved_models: Annotated[Path, Field(description="folder into which `presage save-model` writes")] = Path()
    prior: Annotated[
        Literal["motion", "odometry", "command"],
        Field(
            description="source of the motion between scans; motion: only the last scans; command: results are not "
            "repeatable to the byte, because commands and scans arrive in varying order"
        ),
    ] = "motion"
    sigma: Annotated[
        float | None, Field(gt=0, lt=10, description="m, noise of the scanner; defaults to what scans state, else 0.02")
    ] = None
    seed: Annotated[int, Field(ge=0, le=2**31, description="random seed")] = 0
    initial_pose: Annotated[
        str,
        Field(
            pattern=POSE_PATTERN,
            description="initial pose x,y[,yaw_deg], or x,y for any heading; empty if unknown (paper: the centre)",
        ),
    ] = ""
    alpha: Annotated[
        float, Field(gt=0, lt=1, description="paper: step size of perception along the longest axis, m²")
    ] = 2e-3
    iterations: Annotated[
        int, Field(ge=1, le=1000, description="paper: gradient steps per scan; 1 in the publication")
    ] = 10

    @property
    def changed(self) -> set[str]:
        """Names of the settings that differ from their default."""
        fields = type(self).model_fields
        return {name for name, field in fields.items() if getattr(self, name) != field.default}

    @property
    def robot_names(self) -> list[str]:
        """The names in ``robots``, without the patterns."""
        names = split_names(self.robots)
        return list(dict.fromkeys(name for name in names if re.fullmatch(ROBOT_NAME_PATTERN, name)))

    def check_several_robots(self) -> None:
        """Raises UserError if a setting is only for one robot, or more robots are named than allowed."""
        if self.learn != "none":
            raise UserError("--learn is for one robot: leave it out, or leave out --robots")
        if self.initial_pose:
            raise UserError(
                "initial_pose is for one robot: leave it out with --robots, and set each pose with `presage relocalise`"
            )
        if (count := len(self.robot_names)) > self.max_robots:
            raise UserError(f"{count} robots are named, --max-robots is {self.max_robots}: raise it")


def ignored_settings(estimator: str, given: Collection[str]) -> list[str]:
    """Returns a warning for each of the ``given`` settings that this preset does not use."""
    return [
        f"{name} applies only to preset {preset}; ignored"
        for name, preset in PRESET_OF_SETTING.items()
        if name in given and preset != estimator
    ]
