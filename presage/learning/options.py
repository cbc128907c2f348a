"""Parameters of a training: section `train` of a settings file."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class TrainSettings(BaseModel):
    """Parameters of a training that have no command-line option."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # m, grid spacing of the distance field; defaults to 0.04, and for a recorded drive to 0.05
    resolution: Annotated[float, Field(ge=0.005, le=1.0)] | None = None
    share: Annotated[float, Field(ge=0.01, le=1.0)] = 1.0  # of a recorded drive to train on, from its beginning
    epochs: Annotated[int, Field(ge=1)] = 60  # preset paper
    batch: Annotated[int, Field(ge=1)] = 500  # preset paper
    learning_rate: Annotated[float, Field(ge=1e-6)] = 3e-3  # preset paper
