"""`python -m services.estimator`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

# Must be set before numpy is imported. The matrices are so small that a second thread would only spin while it waits.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from common.runtime.service import main
from services.estimator.settings import EstimatorSettings

if TYPE_CHECKING:
    from common.runtime.service import Service


def build_service(settings: EstimatorSettings) -> Service:
    """Builds the service; imports torch only here, so that --help is fast."""
    if settings.robots:
        from services.estimator.multi_robot import FleetService

        return FleetService(settings)
    from services.estimator.service import EstimatorService

    return EstimatorService(settings)


if __name__ == "__main__":
    main(EstimatorSettings, build_service)
