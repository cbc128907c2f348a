"""The small service as of another presage: PROTOCOL and PRESAGE stand in the environment; run by test_compatibility."""

from __future__ import annotations

import os

import common.versions

known = common.versions.versions()
common.versions.PROTOCOL = int(os.environ.get("FOREIGN_PROTOCOL", str(common.versions.PROTOCOL)))
common.versions.versions = lambda: {**known, "presage": os.environ.get("FOREIGN_PRESAGE", known["presage"])}

from common.runtime.service import main  # noqa: E402 - what it takes from versions is set above
from tests.common.small_service import Small, SmallSettings  # noqa: E402


class Foreign(Small):
    name = "foreign"


class ForeignSettings(SmallSettings):
    """A service of another presage."""

    service = "foreign"


if __name__ == "__main__":
    main(ForeignSettings, Foreign)
