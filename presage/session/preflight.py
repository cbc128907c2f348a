"""Checks that can be made before a process is started."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.errors import UserError
from common.geometry.world import load_world
from common.runtime.config import load_settings
from services.controller.settings import ControllerSettings
from services.estimator.factory import check
from services.estimator.service import choice_of
from services.estimator.settings import EstimatorSettings
from services.simulator.settings import SimulatorSettings


def check_services(
    world: str, estimator: Sequence[str], controller: Sequence[str], simulator: Sequence[str] | None = None
) -> None:
    """Raises the UserError that a service would raise for its arguments and this process's environment.

    ``simulator`` is None if no simulator is started. Models are read, but nothing is compiled and no bus is used.
    """
    loaded_world = load_world(world)
    estimator_settings = load_settings(EstimatorSettings, list(estimator))
    load_settings(ControllerSettings, list(controller)).check()
    if simulator is not None:
        settings = load_settings(SimulatorSettings, list(simulator))
        settings.build_scanner()
        radius, start = settings.build_robot().radius, settings.start_pose()
        pose = loaded_world.start_pose(radius) if start is None else np.array(start)
        if (error := loaded_world.placement_error(pose, radius)) is not None:
            raise UserError(f"start {error} (--start, --radius)")
    check(choice_of(estimator_settings), loaded_world)
