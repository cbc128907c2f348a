"""One line of the doctor's report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One checked fact: whether it is a problem, where, and what to do about it."""

    code: str  # the kind of finding, for programs
    ok: bool | None  # None for information that is not a problem
    what: str
    where: str = ""  # service and host, key, endpoint or path
    advice: str = ""
