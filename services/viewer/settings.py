"""Settings of the viewer."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from common.runtime.config import ServiceSettings

FIRST_PORT = 8080


class ViewerSettings(ServiceSettings):
    """Viewer: serves the live page.

    Anyone who reaches the page can watch. On loopback, visitors can also act (goals, teleport, driving); on other
    addresses only with --allow-control. A token keeps others out. Set it with PRESAGE_VIEWER_TOKEN, because
    command-line arguments are visible in the list of processes.

    Examples:
      python -m services.viewer                                      http://127.0.0.1:8080/, or the next free port
      python -m services.viewer --port 0                             any free port
      PRESAGE_VIEWER_TOKEN=tea python -m services.viewer --host 0.0.0.0 --allow-control

    """

    service: ClassVar[str] = "viewer"
    private: ClassVar[frozenset[str]] = frozenset({"host", "port", "token", "address"})

    host: Annotated[str, Field(min_length=1, max_length=255, description="address to listen on")] = "127.0.0.1"
    port: Annotated[
        int | None,
        Field(ge=0, le=65535, description=f"port; 0 for any free one; defaults to {FIRST_PORT} or the next free one"),
    ] = None
    token: Annotated[
        str,
        Field(
            pattern=r"^[A-Za-z0-9_.~-]{0,200}$",
            description="token that visitors need, of letters, digits and _ . ~ -; empty for none",
        ),
    ] = ""
    allow_control: Annotated[bool, Field(description="let visitors from other machines act, not only watch")] = False
    recordings: Annotated[Path, Field(description="folder of recordings that visitors may open")] = Path("recordings")
    address: Annotated[
        str,
        Field(
            pattern=r"^$|^https?://[^\s/]+$",
            description="address under which visitors reach the page, for the printed link",
        ),
    ] = ""

    @property
    def on_loopback(self) -> bool:
        """Whether only this machine can connect."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def control(self) -> bool:
        """Whether visitors may act."""
        return self.allow_control or self.on_loopback

    def effective(self) -> dict[str, Any]:
        """All settings in effect. The token is masked, because recordings store the settings."""
        return {**super().effective(), "token": "set" if self.token else ""}
