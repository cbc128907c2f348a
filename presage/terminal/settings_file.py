"""The settings file of `--config`."""

from __future__ import annotations

from pathlib import Path

from common.errors import UserError, similar_key
from common.runtime.config import read_settings_file

COMMAND_SECTIONS = ("log", "train")


def check_keys(path: Path | None) -> Path | None:
    """Returns ``path``. Raises UserError if the file has a key at its top that no service and no command reads.

    A service reads its own section and the keys that it knows, so it cannot tell a misspelt key from one of another.
    A missing file is left to the command that reads it.
    """
    if path is None or not path.is_file():
        return path
    # Imported here because most commands run without a settings file.
    from common.router.router import RouterSettings
    from services.bridge_ros2.settings import BridgeRos2Settings
    from services.controller.settings import ControllerSettings
    from services.estimator.settings import EstimatorSettings
    from services.mapper.settings import MapperSettings
    from services.recorder.replaying.service import ReplaySettings
    from services.recorder.settings import RecorderSettings
    from services.simulator.settings import SimulatorSettings
    from services.viewer.settings import ViewerSettings

    services = (
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
