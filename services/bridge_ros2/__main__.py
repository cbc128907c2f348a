"""`python -m services.bridge_ros2`."""

from __future__ import annotations

from common.runtime.service import main
from services.bridge_ros2.service import BridgeRos2Service
from services.bridge_ros2.settings import BridgeRos2Settings

if __name__ == "__main__":
    main(BridgeRos2Settings, BridgeRos2Service)
