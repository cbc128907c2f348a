"""Settings of the recorder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.runtime.config import ServiceSettings


class RecorderSettings(ServiceSettings):
    """Recorder: every message of the session, bytes as sent, into an MCAP file.

    The file is NAME.mcap.active until it is complete; `presage recover` completes one whose recorder was killed.

    Examples:
      python -m services.recorder                                    into recordings/
      python -m services.recorder --directory logs --file run.mcap
      python -m services.recorder --topics scan,odom --compression none
      python -m services.recorder --idle                             records when the page, or a program, says so
      python -m services.recorder --split-minutes 10                 run-001.mcap, run-002.mcap, each whole by itself

    """

    service: ClassVar[str] = "recorder"

    directory: Annotated[Path, Field(description="folder, made where it is missing")] = Path("recordings")
    file: Annotated[str, Field(pattern=r"^[^/]*$", description="name; none: presage-ROBOT-TIME.mcap, UTC")] = ""
    idle: Annotated[bool, Field(description="record nothing until told to: query `recording`")] = False
    topics: Annotated[str, Field(description="comma-separated topic names; empty: all that the table marks")] = ""
    compression: Annotated[Literal["zstd", "lz4", "none"], Field(description="zstd, lz4 or none")] = "zstd"
    # Half of the largest chunk that is read (chunks.py): a message and declarations may come on top.
    chunk_size: Annotated[int, Field(ge=1024, le=1 << 23, description="bytes; a crash loses at most one chunk")] = (
        1 << 18
    )
    flush: Annotated[float, Field(ge=0.05, le=60, description="s; a kill loses at most what came since")] = 0.5
    capacity: Annotated[int, Field(ge=1, le=10_000_000, description="messages that may wait to be written")] = 20_000
    split_size: Annotated[float, Field(ge=0, description="MB of one part; 0: one file")] = 0.0
    split_minutes: Annotated[float, Field(ge=0, description="of one part; 0: one file")] = 0.0
    weights: Annotated[bool, Field(description="store the estimator's weights, up to 16 MiB")] = True
