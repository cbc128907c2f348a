"""The small service with the protocol and presage version that the environment names; run by test_protocol_check."""

from __future__ import annotations

import os

import common.versions

known = common.versions.versions()
common.versions.PROTOCOL = int(os.environ.get("FOREIGN_PROTOCOL", str(common.versions.PROTOCOL)))
common.versions.versions = lambda: {**known, "presage": os.environ.get("FOREIGN_PRESAGE", known["presage"])}

from common.runtime.service import main  # noqa: E402 - it imports values that are set above
from tests.common.small_service import Small, SmallSettings  # noqa: E402


class Foreign(Small):
    name = "foreign"


class ForeignSettings(SmallSettings):
    """A service of another version."""

    service = "foreign"


if __name__ == "__main__":
    main(ForeignSettings, Foreign)
