"""Settings of the mapper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from common.runtime.config import ServiceSettings


class MapperSettings(ServiceSettings):
    """Mapper: builds a map while the robot is driven, and publishes the robot's pose in it.

    It takes the place of the estimator, which needs a finished map.

    Examples:
      python -m services.mapper
      python -m services.mapper --cell 0.02 --maps maps

    """

    service: ClassVar[str] = "mapper"
    private: ClassVar[frozenset[str]] = frozenset({"maps"})

    cell: Annotated[float, Field(ge=0.005, le=1.0, description="edge length of the map's cells, m")] = 0.05
    maps: Annotated[Path, Field(description="folder into which maps are saved")] = Path()
