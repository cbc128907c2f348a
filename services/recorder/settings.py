"""Settings of the recorder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.runtime.config import ServiceSettings


class RecorderSettings(ServiceSettings):
    """Recorder: writes every message of the session unchanged to an MCAP file.

    The file is NAME.mcap.active until it is complete; `presage recover` completes one whose recorder was killed.

    Examples:
      python -m services.recorder                                    records to recordings/
      python -m services.recorder --directory logs --file run.mcap
      python -m services.recorder --topics scan,odom --compression none
      python -m services.recorder --idle                             waits for a request from the page or a program
      python -m services.recorder --split-minutes 10                 NAME-001.mcap, NAME-002.mcap, each complete

    """

    service: ClassVar[str] = "recorder"

    directory: Annotated[Path, Field(description="folder for recordings, created if missing")] = Path("recordings")
    file: Annotated[
        str, Field(pattern=r"^[^/]*$", description="file name; defaults to presage-ROBOT-TIME.mcap, time in UTC")
    ] = ""
    idle: Annotated[bool, Field(description="record nothing until a request (query `recording`) starts it")] = False
    topics: Annotated[str, Field(description="comma-separated topic names; defaults to all recorded topics")] = ""
    compression: Annotated[Literal["zstd", "lz4", "none"], Field(description="zstd, lz4 or none")] = "zstd"
    flush: Annotated[
        float, Field(ge=0.05, le=60, description="flush period in s; a kill loses at most the messages since then")
    ] = 0.5
    split_size: Annotated[float, Field(ge=0, description="maximum size of one part in MB; 0 writes one file")] = 0.0
    split_minutes: Annotated[
        float, Field(ge=0, description="maximum duration of one part in minutes; 0 writes one file")
    ] = 0.0
    weights: Annotated[bool, Field(description="store the estimator's weights, up to 16 MiB")] = True
