"""The settings of a session's services, checked before a process is started."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.errors import UserError
from common.geometry.world import World, load_world
from common.runtime.config import load_settings
from presage.terminal.options import arguments
from presage.terminal.settings_file import check_variables
from services.controller.settings import ControllerSettings
from services.estimator.factory import check_options
from services.estimator.service import estimator_options
from services.estimator.settings import EstimatorSettings
from services.simulator.settings import SimulatorSettings

LOCKSTEP_BELIEF_TIMEOUT_S = 20.0  # in lockstep time waits for the slowest service


@dataclass(frozen=True)
class SessionPlan:
    """Command-line arguments of the services of a session, and the settings that follow from them."""

    config: tuple[str, ...]  # argument of every service
    simulator: tuple[str, ...]
    estimator: tuple[str, ...]
    controller: tuple[str, ...]
    simulator_settings: SimulatorSettings
    estimator_settings: EstimatorSettings


def plan_session(
    config: Path | None,
    world: str,
    drive: str,
    simulator: Sequence[str] = (),
    estimator: Sequence[str] = (),
    *,
    simulated: bool = True,
    mapping: bool = False,
) -> SessionPlan:
    """Checks options, environment and settings file as the services would, so that a mistake is reported once.

    While ``mapping``, no service but the simulator knows the world. Models are read, but nothing is compiled and no bus
    is used. Raises UserError for a mistake.
    """
    check_variables()
    common = arguments(config=config)
    shared = [*common, *arguments(world=world)]
    simulator_args = [*shared, *arguments(drive=drive), *simulator]
    estimator_args = [*shared, *estimator]
    # While mapping, the controller plans in the map that grows.
    controller_args = [*common, *(["--world="] if mapping else arguments(world=world)), *arguments(drive=drive)]
    simulator_settings = load_settings(SimulatorSettings, simulator_args)
    estimator_settings = load_settings(EstimatorSettings, estimator_args)
    # Estimator paper localises at one heading only, which its controller keeps.
    fixed_heading = estimator_settings.estimator == "paper" and not mapping
    if fixed_heading:
        controller_args += arguments(preset="paper")
    if mapping:
        simulator_args += arguments(hide_world=True)
    if simulator_settings.pace == "lockstep":
        controller_args += arguments(belief_timeout=LOCKSTEP_BELIEF_TIMEOUT_S)
    controller_settings = load_settings(ControllerSettings, controller_args)
    if fixed_heading and controller_settings.drive != "holonomic":
        raise UserError(
            "estimator paper needs a robot that moves without turning: set drive to holonomic, or choose another "
            "estimator"
        )
    controller_settings.check()
    loaded_world = load_world(estimator_settings.world)
    if simulated:
        simulator_settings.build_scanner()
        _check_start(simulator_settings, loaded_world)
    if not mapping:
        check_options(estimator_options(estimator_settings), loaded_world)
    return SessionPlan(
        tuple(common),
        tuple(simulator_args),
        tuple(estimator_args),
        tuple(controller_args),
        simulator_settings,
        estimator_settings,
    )


def _check_start(settings: SimulatorSettings, world: World) -> None:
    """Raises UserError if the simulated robot has no room at its start."""
    radius, start = settings.build_robot().radius, settings.start_pose()
    pose = world.start_pose(radius) if start is None else np.array(start)
    if (error := world.placement_error(pose, radius)) is not None:
        raise UserError(f"start {error} (settings start and radius)")
