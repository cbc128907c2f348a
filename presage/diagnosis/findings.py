"""One line of the doctor's report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """What is so, where, and what to do about it."""

    code: str  # of its kind, for programs
    ok: bool | None  # None: worth knowing, no fault
    what: str
    where: str = ""  # service and host, key, endpoint or path
    advice: str = ""
