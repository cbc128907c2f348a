"""Finds misspelt keys of the settings file of `--config`, and misspelt environment variables."""

from __future__ import annotations

import os
from pathlib import Path

from common.errors import UserError, similar_key
from common.runtime.config import ServiceSettings, read_settings_file

COMMAND_SECTIONS = ("log", "train")
PREFIX = "PRESAGE_"
MIN_SIMILARITY = 0.85  # of the rest of a variable's name to that of a setting


def check_keys(path: Path | None) -> Path | None:
    """Returns ``path``. Raises UserError if the file has a key at its top that no service and no command reads.

    A service reads its own section and the keys that it knows, so it cannot tell a misspelt key from one of another.
    A missing file is left to the command that reads it.
    """
    if path is None or not path.is_file():
        return path
    services = _services()
    known = {*COMMAND_SECTIONS, *(cls.service for cls in services)}
    known.update(*(cls.model_fields.keys() - cls.private for cls in services))
    for key in read_settings_file(path):
        if key not in known:
            similar = similar_key(str(key), known)
            raise UserError(
                f"{path}: {key}: unknown key{f'; did you mean {similar}?' if similar else ''}"
                " (docs/settings.yaml lists all)"
            )
    return path


def check_variables() -> None:
    """Raises UserError if an environment variable is probably the misspelt name of a setting.

    A service cannot tell it from a setting of another service, and would use the default, which may be a speed.
    """
    known: set[str] = set()  # without the prefix, by which all would be similar
    for cls in _services():
        known.update(f"{cls.service}_{name}".upper() for name in cls.model_fields)
        known.update(name.upper() for name in cls.model_fields.keys() - cls.private)
    given = {name.removeprefix(PREFIX) for name in os.environ if name.startswith(PREFIX)}
    for name in sorted(given - known):
        if similar := similar_key(name, known, MIN_SIMILARITY):
            raise UserError(
                f"{PREFIX}{name}: there is no such setting; did you mean {PREFIX}{similar}? Else unset this variable"
            )


def _services() -> tuple[type[ServiceSettings], ...]:
    # Imported here because most commands need none of them.
    from common.router.router import RouterSettings
    from services.bridge_ros2.settings import BridgeRos2Settings
    from services.controller.settings import ControllerSettings
    from services.estimator.settings import EstimatorSettings
    from services.mapper.settings import MapperSettings
    from services.recorder.replaying.service import ReplaySettings
    from services.recorder.settings import RecorderSettings
    from services.simulator.settings import SimulatorSettings
    from services.viewer.settings import ViewerSettings

    return (
        RouterSettings,
        SimulatorSettings,
        EstimatorSettings,
        ControllerSettings,
        MapperSettings,
        RecorderSettings,
        ReplaySettings,
        ViewerSettings,
        BridgeRos2Settings,
    )
