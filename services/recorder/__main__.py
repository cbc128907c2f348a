"""`python -m services.recorder`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from common.runtime.service import main
from services.recorder.settings import RecorderSettings

if TYPE_CHECKING:
    from common.runtime.service import Service


def build_service(settings: RecorderSettings) -> Service:
    """Builds the service; imports mcap only here, so that --help is fast."""
    from services.recorder.service import RecorderService

    return RecorderService(settings)


if __name__ == "__main__":
    main(RecorderSettings, build_service)
