"""`python -m services.simulator`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from common.runtime.service import main
from services.simulator.settings import SimulatorSettings

if TYPE_CHECKING:
    from common.runtime.service import Service


def build_service(settings: SimulatorSettings) -> Service:
    """Builds the service; imports pybullet only here, so that --help is fast."""
    from services.simulator.service import SimulatorService

    return SimulatorService(settings)


if __name__ == "__main__":
    main(SimulatorSettings, build_service)
