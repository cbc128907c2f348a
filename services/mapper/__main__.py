"""`python -m services.mapper`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

# Must be set before numpy is imported. The matrices are so small that a second thread would only spin while it waits.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from common.runtime.service import main
from services.mapper.settings import MapperSettings

if TYPE_CHECKING:
    from common.runtime.service import Service


def build_service(settings: MapperSettings) -> Service:
    """Builds the service; imports numba only here, so that --help is fast."""
    from services.mapper.service import MapperService

    return MapperService(settings)


if __name__ == "__main__":
    main(MapperSettings, build_service)
