"""The SHA-256 of a weights file, checked when it is loaded."""

from __future__ import annotations

import functools
import hashlib
import logging
from typing import TYPE_CHECKING

from common.errors import UserError

if TYPE_CHECKING:
    from pathlib import Path


def sha256(data: bytes) -> str:
    """Hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def check_digest(path: Path, data: bytes, expected: str, command: str) -> None:
    """Raise UserError where ``data``, read from ``path``, are not what the card describes.

    Cards written before the digest existed have an empty one. They are accepted with a warning, since old recordings
    hold such cards. ``command`` is the one that trains the weights.
    """
    if not expected:
        _warn(path, command)
    elif sha256(data) != expected:
        raise UserError(
            f"weights {path}: the file is damaged, or belongs to another card: its SHA-256 is not the one in "
            f"{path.with_suffix('.json').name}. Restore both files, or train again with: {command}"
        )


@functools.cache
def _warn(path: Path, command: str) -> None:
    """Once for each file."""
    logging.getLogger("estimator").warning(
        "%s: its model card has no digest, so damage cannot be detected; training again adds one: %s", path, command
    )
