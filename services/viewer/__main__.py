"""`python -m services.viewer`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from common.runtime.service import main
from services.viewer.settings import ViewerSettings

if TYPE_CHECKING:
    from common.runtime.service import Service


def build_service(settings: ViewerSettings) -> Service:
    """Builds the service; imports the web server only here, so that --help is fast."""
    from services.viewer.service import ViewerService

    return ViewerService(settings)


if __name__ == "__main__":
    main(ViewerSettings, build_service)
